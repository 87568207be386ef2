"""Telemetry: an id and a log line for every request, and numbers for Prometheus."""

from __future__ import annotations

import logging
import time
import uuid
from collections.abc import Iterator
from typing import Any

from prometheus_client import CollectorRegistry, Histogram
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.registry import Collector
from starlette.datastructures import MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.context import Context

LOG = logging.getLogger("service.requests")
METHODS = frozenset(("GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"))


class Telemetry:
    """Middleware: measures until an answer begins, as event streams end only with their job."""

    def __init__(self, app: ASGIApp, registry: CollectorRegistry) -> None:
        self._app = app
        labels = ("route", "method", "status")
        text = "Seconds until an answer begins."
        self._seconds = Histogram("graings_request_seconds", text, labels, registry=registry)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        request_id, began = uuid.uuid4().hex[:16], time.perf_counter()

        async def measured(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message)["X-Request-Id"] = request_id
                seconds, status = time.perf_counter() - began, message["status"]
                # A client may send any word as its method; each would be a histogram that stays.
                method = scope["method"] if scope["method"] in METHODS else "other"
                route = getattr(scope.get("route"), "path", "none")  # not the path, which is another for each job
                self._seconds.labels(route, method, status).observe(seconds)
                job = scope.get("path_params", {}).get("job_id")
                fields = {"request": request_id, "job": job, "status": status, "seconds": round(seconds, 4)}
                LOG.info("%s %s", method, scope["path"], extra=fields)
            await send(message)

        await self._app(scope, receive, measured)


class ServiceNumbers(Collector):
    """Numbers that are read when they are asked for."""

    def __init__(self, context: Context) -> None:
        self._context = context

    def collect(self) -> Iterator[Any]:
        context = self._context
        progress = [context.jobs.get(entry.job_id).progress for entry in context.engine.running()]
        rates = [report.iterations_per_s or 0.0 for report in progress if report is not None]
        for name, text, value in (
            ("jobs_waiting", "Jobs that wait for a worker.", context.jobs.waiting()),
            ("jobs_running", "Jobs that are being trained.", len(progress)),
            ("iterations_per_second", "Of all running jobs.", sum(rates)),
            ("workers", "Live workers.", context.leases.alive()),
            ("images_rendering", "Images that are rendered or wait for a thread.", context.pool.running),
            ("free_bytes", "Free space in the data folder.", context.free_mb() * 1_000_000),
        ):
            yield GaugeMetricFamily(f"graings_{name}", text, value)
