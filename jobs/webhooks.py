"""Webhooks: what happens to a job, sent to an address that its submitter has chosen.

Signed after Standard Webhooks with its library. The address may be anybody's: redirects are not followed, and addresses
inside a private network are refused, as the worker may reach there what the submitter may not.
"""

from __future__ import annotations

import asyncio
import json
import os
import socket
from datetime import UTC, datetime
from ipaddress import ip_address
from typing import Any

import httpx2
from standardwebhooks import Webhook

from jobs.job import Job

PRIVATE = "GRAINGS_PRIVATE_WEBHOOKS"
TIMEOUT_S = 15.0
# Seconds before each further attempt: about three days in all, as the specification advises.
RETRY_AFTER_S = (5, 60, 300, 1_800, 7_200, 18_000, 36_000, 50_400, 72_000, 86_400)


class WebhookError(Exception):
    """A message was not taken."""


def message(job: Job, event: str) -> dict[str, Any]:
    """The message that something happened to a job: `started`, `checkpoint` or `ended`."""
    data = {"id": job.id, "name": job.spec.name, "state": job.state, "error": job.error, "checkpoint": job.checkpoint}
    return {"type": f"job.{event}", "timestamp": datetime.now(UTC).isoformat(), "data": data}


def deliver(url: str, secret: str, message_id: str, content: dict[str, Any]) -> None:
    """Send a message once. Raises `WebhookError` unless the receiver answers with a status of success."""
    body, now = json.dumps(content), datetime.now(UTC)
    try:
        target = httpx2.URL(url)
        # To the address that was checked: another look-up of the name could give another one.
        pinned = target.copy_with(host=_address(target))
        headers = {
            "Host": target.netloc.decode(),
            "Content-Type": "application/json",
            "webhook-id": message_id,
            "webhook-timestamp": str(int(now.timestamp())),
            "webhook-signature": Webhook(secret).sign(message_id, now, body),
        }
        status = asyncio.run(_status(pinned, target.host, headers, body))
    except TimeoutError as error:
        raise WebhookError(f"{url}: did not answer within {TIMEOUT_S:g} s") from error
    except (httpx2.HTTPError, httpx2.InvalidURL, OSError, ValueError) as error:
        raise WebhookError(f"{url}: {error or type(error).__name__}") from error
    if not 200 <= status < 300:
        raise WebhookError(f"{url}: answered {status}")


async def _status(url: httpx2.URL, server: str, headers: dict[str, str], body: str) -> int:
    """The status that `server` answers with; what follows it is not read. Raises `TimeoutError`.

    There is one deadline for all: a timeout of the client's begins again with each byte that the receiver sends.
    """
    async with asyncio.timeout(TIMEOUT_S), httpx2.AsyncClient(timeout=None, trust_env=False) as client:
        request = client.build_request("POST", url, content=body, headers=headers)
        request.extensions["sni_hostname"] = server
        response = await client.send(request, stream=True)
        await response.aclose()
        return response.status_code


def _address(target: httpx2.URL) -> str:
    """The address of the receiver. Raises `WebhookError` for one that is not public, unless that is allowed."""
    port = target.port or (443 if target.scheme == "https" else 80)
    found = [str(entry[4][0]) for entry in socket.getaddrinfo(target.host, port, type=socket.SOCK_STREAM)]
    if not os.environ.get(PRIVATE) and not all(map(_is_public, found)):
        raise WebhookError(f"{target.host} is in a private network. Workers with {PRIVATE}=1 allow that.")
    return found[0]


def _is_public(text: str) -> bool:
    address = ip_address(text)
    address = getattr(address, "ipv4_mapped", None) or address
    return address.is_global and not address.is_multicast
