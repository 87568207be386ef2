"""Negotiation: which of the formats on offer a client would rather have (RFC 9110, section 12.5.1)."""

from __future__ import annotations

from collections.abc import Sequence


def preferred(accept: str | None, offers: Sequence[str]) -> str | None:
    """The media type of `offers` that the header wants most, the earlier offer at a tie; None if it takes none."""
    ranges = [_parse(part) for part in (accept or "*/*").split(",") if part.strip()]
    best, best_weight = None, 0.0
    for offer in offers:
        weight = _weight(offer, ranges)
        if weight > best_weight:
            best, best_weight = offer, weight
    return best


def _parse(part: str) -> tuple[str, float]:
    media, *parameters = (piece.strip().lower() for piece in part.split(";"))
    weight = 1.0
    for parameter in parameters:
        name, _, value = parameter.partition("=")
        if name.strip() == "q":
            try:
                weight = min(1.0, max(0.0, float(value)))
            except ValueError:
                weight = 0.0  # a weight that is none asks for nothing
    return media, weight if weight == weight else 0.0


def _weight(offer: str, ranges: list[tuple[str, float]]) -> float:
    """The weight of the most specific range that the offer falls in."""
    for pattern in (offer, offer.split("/")[0] + "/*", "*/*"):
        for media, weight in ranges:
            if media == pattern:
                return weight
    return 0.0
