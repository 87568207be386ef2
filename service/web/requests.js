// Requests to the service, and what the session of this browser may do.

import { refusal } from "/web/player/scene_file.js";

export async function request(path, options) {
  const response = await fetch(path, options);
  if (!response.ok) throw await refusal(response);
  return response.status === 204 ? null : response.json();
}

const SCOPES = ["view", "read", "train", "admin"];

export const session = { scope: "admin", name: null };

export const may = (scope) => SCOPES.indexOf(session.scope) >= SCOPES.indexOf(scope);

export async function signIn(secret) {
  await request("/session", { method: "POST", headers: { Authorization: `Bearer ${secret}` } });
  location.replace("/");
}

export const signOut = () => request("/session", { method: "DELETE" }).then(() => location.replace("/"));
