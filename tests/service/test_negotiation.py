from __future__ import annotations

import pytest

from service.negotiation import preferred

OFFERS = ["image/png", "image/jpeg", "image/webp"]


@pytest.mark.parametrize(
    ("accept", "chosen"),
    [
        (None, "image/png"),
        ("*/*", "image/png"),
        ("image/*", "image/png"),
        ("image/webp", "image/webp"),
        ("text/html", None),
        ("image/png;q=0.5, image/jpeg;q=0.8", "image/jpeg"),
        ("image/png;q=0, image/*", "image/jpeg"),
        ("image/*;q=0.3, */*;q=0.9", "image/png"),
        ("image/avif,image/webp,*/*;q=0.8", "image/webp"),
        ("IMAGE/WEBP ; Q=1", "image/webp"),
        ("image/png;q=nan", None),
        ("image/png;q=x, image/jpeg;q=0.1", "image/jpeg"),
        ("", "image/png"),
    ],
)
def test_the_most_wanted_offer_is_chosen(accept: str | None, chosen: str | None) -> None:
    assert preferred(accept, OFFERS) == chosen
