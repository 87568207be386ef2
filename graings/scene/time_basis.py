"""TimeBasis: values of many children over time as a few shared functions of time, and the fit of such a basis.

The offset of child i is the vector sum_r a_ir b_r(t): the weight a_ir is a number, the function b_r a vector of all
values that the basis describes. Functions with vector values need fewer weights than one basis for each coordinate: of
a rigid motion x -> R(t) x + p(t) four describe every point, with the weights (x, 1), and the same four carry its
rotation.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from graings.scene.child_blocks import ActiveUnits

# Children that the functions are learned from, evenly chosen; weights are then found for all.
LEARNED_FROM: Final = 4096
CHILDREN_AT_ONCE: Final = 16384
MOST_SAMPLES: Final = 1025  # of each function of time
QUANTILE: Final = 0.99  # of the errors of children and instants: what the bound holds for
# Share of the bound that the rank may use; the rest is for the interpolation between samples.
RANK_SHARE: Final = 0.85


@dataclass(frozen=True, slots=True, eq=False)
class TimeBasis:
    """Offsets sum_r weights[i, r] functions(t)[r] of the children `rows`; those of all others are zero.

    Each column of `weights` lies in [-1, 1] and reaches one of the two, so that its quantisation needs no scale: units
    and sizes are in `functions`, at the times j / (sample - 1). Between these it is linear.
    """

    rows: Int64[Tensor, " moving"]  # ascending
    weights: Float[Tensor, "moving rank"]  # float32
    functions: Float[Tensor, "sample rank value"]  # float32; one sample: constant

    @staticmethod
    def empty(values: int) -> TimeBasis:
        """Without offsets."""
        return TimeBasis(torch.empty(0, dtype=torch.int64), torch.empty(0, 0), torch.empty(1, 0, values))

    @property
    def rank(self) -> int:
        """Number of functions."""
        return self.weights.shape[1]

    @property
    def bytes(self) -> int:
        """Size of weights and functions in float32."""
        return 4 * (self.weights.numel() + self.functions.numel())

    def in_blocks(self, children: int, dtype: torch.dtype) -> ActiveUnits:
        """Weights of all `children` in blocks for the kernel; a block in which none has weights takes no memory."""
        return ActiveUnits.of(
            torch.zeros(children, self.rank, dtype=dtype).index_copy(0, self.rows, self.weights.to(dtype))
        )

    def at(self, time: float) -> Float[Tensor, "rank value"]:
        """The functions at `time` in [0, 1]."""
        return interpolated(self.functions, time)

    def offsets(self, time: float) -> Float[Tensor, "moving value"]:
        """Offsets of the children `rows` at `time`."""
        return self.weights @ self.at(time)


class TimeSignal(ABC):
    """What a basis describes: offsets [child, value] from a state that does not change in time."""

    # How much an error of each child and of each value counts: the least squares of the fit.
    child_scales: Float[Tensor, " child"]
    value_scales: Float[Tensor, " value"]

    @abstractmethod
    def at(self, time: float, rows: Int64[Tensor, " row"]) -> Float[Tensor, "row value"]:
        """Offsets of the children `rows` (ascending) at `time`."""

    @abstractmethod
    def errors(
        self, rows: Int64[Tensor, " row"], found: Float[Tensor, "row value"], expected: Float[Tensor, "row value"]
    ) -> Float[Tensor, " row"]:
        """Size of the error of each child with offsets `found` for `expected`, in the unit of the bound."""


def interpolated(functions: Float[Tensor, "sample rank value"], time: float) -> Float[Tensor, "rank value"]:
    """Linear between samples at the times j / (sample - 1)."""
    last = len(functions) - 1
    at = min(max(time, 0.0), 1.0) * last
    before = min(int(at), max(last - 1, 0))
    return torch.lerp(functions[before], functions[min(before + 1, last)], at - before)


def pieces(rows: Tensor) -> Iterator[Tensor]:
    """`rows` of children in parts that fit into caches and memory."""
    return iter(rows.split(CHILDREN_AT_ONCE)) if len(rows) else iter(())


def between(times: Sequence[float]) -> list[float]:
    """A time between each two neighbours of ascending `times`, each time in another part of the interval.

    Never where a finer grid has a sample, because there the interpolation of `TimeBasis` has no error.
    """
    parts = [(0.5 + number * 0.6180339887498949) % 1.0 for number in range(len(times))]
    parts[0] = 0.45
    return [one + part * (other - one) for part, one, other in zip(parts, times, times[1:], strict=False)]


def fit(
    signal: TimeSignal, rows: Int64[Tensor, " moving"], times: Sequence[float], checked: Sequence[float], bound: float
) -> tuple[TimeBasis, Float[Tensor, "time moving"]]:
    """The basis of least rank whose error is within `bound` for 99 % of the children `rows` and the times `checked`.

    Functions are the leading right singular vectors of the offsets at `times` (evenly spaced, ascending from 0 to 1).
    Also returns the errors at `checked`.
    """
    if not len(rows):
        return TimeBasis.empty(len(signal.value_scales)), signal.child_scales.new_zeros(len(checked), 0)
    functions = _Functions(signal, rows[:: -(-len(rows) // LEARNED_FROM)], times, checked)
    rank = functions.least_rank(RANK_SHARE * bound)
    while True:
        samples = functions.samples(rank, bound)
        weights = torch.cat([functions.weights(piece, rank) for piece in pieces(rows)])
        largest = weights.abs().amax(0).clamp_min(torch.finfo(torch.float32).tiny)
        basis = TimeBasis(rows, weights / largest, samples * largest.unsqueeze(-1))
        found = errors(signal, basis, checked)
        if rank == functions.highest_rank or quantile(found) <= bound:
            return basis, found
        rank = min(functions.highest_rank, rank + max(1, rank // 6))


def errors(signal: TimeSignal, basis: TimeBasis, times: Sequence[float]) -> Float[Tensor, "time moving"]:
    """Errors of the children of the basis at `times`."""
    dtype = signal.child_scales.dtype
    functions = [(time, basis.at(time).to(dtype)) for time in times]
    found = [signal.child_scales.new_zeros(len(times), 0)]
    for rows, weights in zip(pieces(basis.rows), pieces(basis.weights.to(dtype)), strict=True):
        offsets = ((weights @ values, signal.at(time, rows)) for time, values in functions)
        found.append(torch.stack([signal.errors(rows, here, there) for here, there in offsets]))
    return torch.cat(found, dim=1)


def quantile(values: Float[Tensor, " *shape"]) -> float:
    """The 0.99 quantile; 0 of nothing."""
    flat = values.flatten()
    return float(flat.kthvalue(max(1, round(QUANTILE * flat.numel()))).values) if flat.numel() else 0.0


class _Functions:
    """Functions of time learned from some children, from the most important one on."""

    def __init__(self, signal: TimeSignal, children: Tensor, times: Sequence[float], checked: Sequence[float]) -> None:
        self._signal, self._children, self._times = signal, children, times
        self._checked = [(time, signal.at(time, children)) for time in checked]
        sampled = torch.stack([signal.at(time, children) for time in times], dim=1).double()
        if not bool(sampled.isfinite().all()):
            raise ValueError("the motion of this model is not finite: train it again, or use an earlier checkpoint")
        self._scales = signal.child_scales[children].double().unsqueeze(1)
        matrix = self._scales * (sampled * signal.value_scales.double()).flatten(1)
        squares, vectors = torch.linalg.eigh(matrix.T @ matrix)
        # Squares of singular values are known to a rounding error of the largest.
        kept = int((squares > 1e-13 * squares[-1]).sum())
        self._squares, self._vectors = squares.flip(0)[:kept], vectors.flip(1)[:, :kept]
        self._learned = matrix @ self._vectors
        self._samples = self._fitted(sampled.flatten(1)).unflatten(1, (len(times), -1)).transpose(0, 1)
        self.highest_rank = kept

    def weights(self, rows: Tensor, rank: int) -> Tensor:
        """Of the children `rows`, not normalised."""
        sampled = torch.stack([self._signal.at(time, rows) for time in self._times], dim=1)
        scaled = (sampled * self._signal.value_scales).flatten(1)
        return (scaled @ self._vectors[:, :rank].to(scaled.dtype)).float()

    def _fitted(self, offsets: Tensor) -> Tensor:
        """All functions at a time: those that give the learned children these offsets with the least square error."""
        return (self._learned.T @ (self._scales * offsets)) / self._squares.unsqueeze(1)

    def least_rank(self, bound: float) -> int:
        """The least one whose error is within `bound`, with functions that are known at every time."""
        known = [(offsets, self._fitted(offsets.double())) for _, offsets in self._checked[::2]]
        low, high = 1, self.highest_rank
        while low < high:
            middle = (low + high) // 2
            if self._error(middle, known) <= bound:
                high = middle
            else:
                low = middle + 1
        return low

    def samples(self, rank: int, bound: float) -> Tensor:
        """As few samples of the functions as keep the error within `bound`, at least one for each of the times."""
        samples = self._samples[:, :rank]
        while 1 < len(samples) <= MOST_SAMPLES // 2 + 1:
            if self._error(rank, [(offsets, interpolated(samples, time)) for time, offsets in self._checked]) <= bound:
                break
            count = 2 * len(samples) - 1
            finer = samples.new_empty(count, *samples.shape[1:])
            finer[::2] = samples
            for j in range(1, count, 2):
                finer[j] = self._fitted(self._signal.at(j / (count - 1), self._children).double())[:rank]
            samples = finer
        return samples.float()

    def _error(self, rank: int, known: Sequence[tuple[Tensor, Tensor]]) -> float:
        weights = self._learned[:, :rank] / self._scales
        found = [
            self._signal.errors(self._children, (weights @ functions[:rank]).to(offsets.dtype), offsets)
            for offsets, functions in known
        ]
        return quantile(torch.stack(found))
