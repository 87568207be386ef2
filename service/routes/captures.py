"""The route of captures: what is in one, before a job is queued."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, Request

from graings.config import make_config
from graings.inspection.document import Inspection
from service.context import ContextDep
from service.inspection import describe_capture
from service.problems import RESPONSES
from service.uploads import CAPTURE_BODY, parse_config, receive_capture

router = APIRouter(prefix="/captures", tags=["captures"], responses=RESPONSES)


@router.post("", operation_id="inspect_capture", openapi_extra=CAPTURE_BODY)
async def inspect(
    request: Request,
    context: ContextDep,
    config: Annotated[
        str | None, Query(description="Options as a JSON object, nested or with dotted keys, see /options.")
    ] = None,
) -> Inspection:
    """What is in the capture in the body, what is suspicious about it, and what trainings would take.

    The body is the same as for `POST /jobs`. Nothing is queued, and nothing of the capture is kept.
    """
    overrides = {} if config is None else parse_config(config, "config")
    make_config(overrides=overrides)  # before the body is read
    async with receive_capture(request, context.store.uploads, context.limits) as upload:
        chosen = make_config(overrides={**overrides, **upload.config})
        return await describe_capture(upload.folder, chosen.capture)
