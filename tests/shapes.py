"""The type checker behind the shape annotations: beartype, which cannot judge numpy's ArrayLike."""

from __future__ import annotations

from beartype import BeartypeConf, FrozenDict, beartype
from numpy.typing import ArrayLike

checked = beartype(conf=BeartypeConf(hint_overrides=FrozenDict({ArrayLike: object})))
