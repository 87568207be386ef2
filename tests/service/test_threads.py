"""A request does not go from thread to thread: FastAPI gives every dependency that is no coroutine a thread."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from anyio import to_thread
from fastapi.dependencies.models import Dependant
from fastapi.routing import APIRoute
from starlette.testclient import TestClient

from service import routes
from service.access import authorize

MODULES = [module.name for module in pkgutil.iter_modules(routes.__path__)]


def below(dependant: Dependant) -> Iterator[Callable[..., Any]]:
    """All functions on which a route depends, directly or not."""
    for dependency in dependant.dependencies:
        assert dependency.call is not None
        yield dependency.call
        yield from below(dependency)


def takes_a_thread(call: Callable[..., Any]) -> bool:
    functions = (call, type(call).__call__)  # security schemes are objects with such a method
    return not any(inspect.iscoroutinefunction(f) or inspect.isasyncgenfunction(f) for f in functions)


def test_no_dependency_takes_a_thread() -> None:
    assert takes_a_thread(takes_a_thread)
    assert not takes_a_thread(authorize)
    found = set[str]()
    for name in MODULES:
        module = importlib.import_module(f"service.routes.{name}")
        for router in (module.router, getattr(module, "open_router", None)):
            for route in () if router is None else router.routes:
                assert isinstance(route, APIRoute)
                calls = list(below(route.dependant))
                found.update(str(getattr(call, "__name__", "")) for call in calls)
                assert [call for call in calls if takes_a_thread(call)] == [], route.path
    assert {"_context_of", "_caller_of", "owned", "_known"} <= found


@pytest.mark.parametrize(("path", "most"), [("/healthz", 0), ("/jobs", 3), ("/render?t=0.5&width=16", 2)])
def test_requests_take_few_threads(client: TestClient, monkeypatch: pytest.MonkeyPatch, path: str, most: int) -> None:
    run_sync = to_thread.run_sync
    taken: list[str] = []

    async def counting(function: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
        taken.append(repr(function))
        return await run_sync(function, *arguments, **options)

    monkeypatch.setattr(to_thread, "run_sync", counting)
    client.get(path)
    assert len(taken) <= most, taken
