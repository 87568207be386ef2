"""The route of captures: what is in one, before a job is queued."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, Request

from graings.config import make_config, merged
from graings.inspection.document import Inspection
from service.access import CallerDep
from service.context import ContextDep
from service.inspection import describe_capture
from service.problems import RESPONSES
from service.sent_capture import OPTIONAL_BODY, CaptureParam, sent_capture
from service.uploads import parse_config

router = APIRouter(prefix="/captures", tags=["captures"], responses=RESPONSES)


@router.post("", operation_id="inspect_capture", openapi_extra=OPTIONAL_BODY)
async def inspect(
    request: Request,
    context: ContextDep,
    caller: CallerDep,
    config: Annotated[
        str | None, Query(description="Options as a JSON object, nested or with dotted keys, see /options.")
    ] = None,
    capture: CaptureParam = None,
) -> Inspection:
    """What is in the capture in the body or sent before, what is suspicious about it, and what trainings would take.

    Its body and `capture` are those of `POST /jobs`. Nothing is queued, and nothing of the capture is kept.
    """
    overrides = {} if config is None else parse_config(config, "config")
    make_config(overrides=overrides)  # before the body is read
    async with sent_capture(request, context, caller, capture) as sent:
        chosen = make_config(overrides=merged(overrides, sent.config))
        return await describe_capture(sent.folder, chosen.capture)
