"""The route of plans: what a training would leave out and how long it would take, before a job is queued."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, Request

from graings.config import PRESETS, make_config, merged
from graings.plan.plan import Plan
from service.access import CallerDep
from service.context import ContextDep
from service.inspection import plan_capture
from service.problems import RESPONSES
from service.sent_capture import OPTIONAL_BODY, CaptureParam, sent_capture
from service.uploads import parse_config

router = APIRouter(prefix="/plans", tags=["plans"], responses=RESPONSES)


@router.post("", operation_id="plan_training", openapi_extra=OPTIONAL_BODY)
async def plan(
    request: Request,
    context: ContextDep,
    caller: CallerDep,
    preset: Annotated[str, Query(description=f"Source of default values: {', '.join(PRESETS)}.")] = "standard",
    config: Annotated[
        str | None, Query(description="Options as a JSON object, nested or with dotted keys, see /options.")
    ] = None,
    capture: CaptureParam = None,
) -> Plan:
    """The plan of a training on the capture in the body, or sent before, as for `POST /jobs`.

    Nothing is queued, and nothing of the capture is kept.
    """
    overrides = {} if config is None else parse_config(config, "config")
    make_config(preset, overrides)  # before the body is read
    async with sent_capture(request, context, caller, capture) as sent:
        return await plan_capture(sent.folder, make_config(preset, merged(overrides, sent.config)))
