// Failure: why an action of the user failed. It is shown until the next action, or until it is dismissed.

const $ = (id) => document.getElementById(id);

/** @param {Error} error */
export function showFailure(error) {
  $("failure").querySelector("span").textContent = error.message;
  $("failure").hidden = false;
}

const hide = () => ($("failure").hidden = true);

/**
 * Runs an action of the user, and shows why it failed if it does.
 * @param {() => any} action
 */
export async function attempt(action) {
  hide();
  try {
    await action();
  } catch (error) {
    showFailure(error);
  }
}

$("failure").querySelector("button").onclick = hide;
