"""Behind the proxy of the Docker set-up the cookie of a session is only sent over HTTPS."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from starlette.testclient import TestClient
from uvicorn.middleware.proxy_headers import ProxyHeadersMiddleware

from service.app import create_app
from service.keys import Keys, Scope
from service.settings import Settings

COMPOSE = Path(__file__).parents[2] / "docker" / "compose.yaml"


def trusted() -> str:
    """What compose gives uvicorn unless the operator gives something else: `${NAME:-DEFAULT}`."""
    api = yaml.safe_load(COMPOSE.read_text())["services"]["api"]
    value: str = api["environment"]["FORWARDED_ALLOW_IPS"]
    assert value.startswith("${FORWARDED_ALLOW_IPS:-")
    return value.removeprefix("${FORWARDED_ALLOW_IPS:-").removesuffix("}")


@pytest.mark.parametrize(
    ("address", "secure"),
    [
        ("172.17.0.1", True),  # the gateways of Docker's networks, from which a proxy on the host comes
        ("172.31.0.1", True),
        ("192.168.16.1", True),
        ("203.0.113.9", False),
        ("10.0.0.9", False),
    ],
)
def test_only_the_proxy_is_believed_that_a_request_came_over_https(
    settings: Settings, address: str, secure: bool
) -> None:
    secret = Keys(settings.data / "keys").create("me", Scope.TRAIN)[1]
    app = ProxyHeadersMiddleware(create_app(settings), trusted())  # type: ignore[arg-type]
    with TestClient(app, client=(address, 50_000)) as client:  # type: ignore[arg-type]
        headers = {"Authorization": f"Bearer {secret}", "X-Forwarded-Proto": "https"}
        cookie = client.post("/session", headers=headers).headers["set-cookie"].lower()
    assert ("; secure" in cookie) is secure


def test_the_api_keeps_the_settings_that_it_shares_with_workers_and_no_other_machine_reaches_its_port() -> None:
    services = yaml.safe_load(COMPOSE.read_text())["services"]
    shared = services["worker"]["environment"]
    assert shared.items() <= services["api"]["environment"].items()
    assert "FORWARDED_ALLOW_IPS" not in shared
    assert all(port.startswith("127.0.0.1:") for port in services["api"]["ports"])
