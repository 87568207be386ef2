"""The type checker of the shape annotations: beartype, except for numpy's ArrayLike, which it does not support."""

from __future__ import annotations

from beartype import BeartypeConf, FrozenDict, beartype
from numpy.typing import ArrayLike

checked = beartype(conf=BeartypeConf(hint_overrides=FrozenDict({ArrayLike: object})))
