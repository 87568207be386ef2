"""The route of plans: what a training would leave out and how long it would take, before a job is queued."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, Request

from graings.config import PRESETS, make_config
from graings.plan.plan import Plan
from service.context import ContextDep
from service.inspection import plan_capture
from service.problems import RESPONSES
from service.uploads import CAPTURE_BODY, parse_config, receive_capture

router = APIRouter(prefix="/plans", tags=["plans"], responses=RESPONSES)


@router.post("", operation_id="plan_training", openapi_extra=CAPTURE_BODY)
async def plan(
    request: Request,
    context: ContextDep,
    preset: Annotated[str, Query(description=f"Source of default values: {', '.join(PRESETS)}.")] = "standard",
    config: Annotated[
        str | None, Query(description="Options as a JSON object, nested or with dotted keys, see /options.")
    ] = None,
) -> Plan:
    """The plan of a training on the capture in the body, which is the same as for `POST /jobs`.

    Nothing is queued, and nothing of the capture is kept.
    """
    overrides = {} if config is None else parse_config(config, "config")
    make_config(preset, overrides)  # before the body is read
    async with receive_capture(request, context.store.uploads, context.limits) as upload:
        return await plan_capture(upload.folder, make_config(preset, {**overrides, **upload.config}))
