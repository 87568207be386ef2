"""Optimizer: Adam over named groups with log-linear learning rates, Muon for hidden weight matrices, and rows of
moments that are added and removed with the anchors.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor, nn

from graings.config import RatesConfig, TrainConfig
from graings.scene.scaffold import Scaffold
from graings.scene.scene import Scene
from graings.training.guard.guard import Gradient
from graings.training.muon import Muon
from graings.training.subnormals import flushed_subnormals

# Learning rates are those of one view per step; with more views they are multiplied by their number to this power.
# Steps of four views at 1.5 times the rates reach the same quality as twice as many steps of two views
# (docs/experiments/).
BATCH_POWER = 1 / 3

ADAM_EPSILON = 1e-15  # as 3DGS: gradients of one Gaussian are tiny, and the usual 1e-8 would damp them

MOMENTUM_OF = "momentum"

# Which group a parameter belongs to, by the head of its name in the scene.
_GROUPS = {
    "scaffold.anchors": "anchors",
    "scaffold.offsets": "offsets",
    "scaffold.features": "features",
    "scaffold.log_scales": "log_scales",
    "scaffold.opacity_offsets": "opacity_offsets",
    "static": "static",
    "single": "deformation",
    "appearance.color": "color",
    "appearance.normal": "color",
    "appearance.opacity": "opacity",
    "residual": "residual",
    "deformation": "deformation",
}

# Groups whose hidden weight matrices Muon steps: motion is learned in fewer steps. The rest is stepped by Adam.
_ORTHOGONAL = ("deformation", "static")
MATRICES = "matrices"  # the rate of all of them

# Groups that are trained in the joint phase only: their schedule spans it.
TEMPORAL_GROUPS = ("residual", "deformation")


def _group_of(name: str) -> str:
    for head, group in _GROUPS.items():
        if name == head or name.startswith(head + "."):
            return group
    raise ValueError(f"parameter {name} belongs to no optimiser group")


def _steps_by_muon(name: str, parameter: nn.Parameter) -> bool:
    matrix = parameter.ndim == 2 and name.endswith(".weight") and ".out." not in name
    return matrix and _group_of(name) in _ORTHOGONAL


class Optimizer:
    """Adam, and Muon, for one scene, and steps that look at `views` views each.

    `step(iteration)` sets the rates for that iteration, steps the groups whose parameters have gradients and
    clears the gradients. `damping` is a factor on all rates.
    """

    def __init__(self, scene: Scene, config: TrainConfig, joint_from: int, views: int = 1) -> None:
        self.scene = scene
        self.rates: RatesConfig = config.rates
        self.batch_factor = views**BATCH_POWER
        self.extent = float(scene.extent)
        self.iterations = config.iterations
        self.joint_from = joint_from
        self.damping = 1.0
        members: dict[str, list[nn.Parameter]] = {}
        matrices: list[nn.Parameter] = []
        self._muon_groups: list[str] = []
        for name, parameter in scene.named_parameters():
            if config.matrix_optimizer == "muon" and _steps_by_muon(name, parameter):
                matrices.append(parameter)
                self._muon_groups.append(_group_of(name))
            else:
                members.setdefault(_group_of(name), []).append(parameter)
        groups = [{"params": parameters, "name": group, "lr": 0.0} for group, parameters in members.items()]
        self.adam = torch.optim.Adam(groups, eps=ADAM_EPSILON, fused=True)
        self.muon = Muon(matrices)

    def rate(self, group: str, iteration: int, like: str | None = None) -> float:
        """Learning rate of `group` at `iteration` (from 1): log-linear, times the factor for the views per step.

        It spans the iterations in which `like` (default: the group itself) is trained.
        """
        first, last = getattr(self.rates, group)
        start = self.joint_from if (like or group) in TEMPORAL_GROUPS else 0
        progress = min(1.0, max(0.0, (iteration - start) / max(1, self.iterations - start)))
        if first <= 0 or last <= 0:
            return self.batch_factor * float(first + (last - first) * progress)
        return self.batch_factor * math.exp(math.log(first) + (math.log(last) - math.log(first)) * progress)

    def step(self, iteration: int) -> None:
        """Apply the gradients at the rates of `iteration`."""
        for group in self.adam.param_groups:
            group["lr"] = self.damping * self.rate(group["name"], iteration)
            if group["name"] == "anchors":
                group["lr"] *= self.extent
        # The first moment of an anchor that no view shows decays by a tenth per step and would stay subnormal for ever.
        with flushed_subnormals():
            self.adam.step()
        self.muon.step([self.damping * self.rate(MATRICES, iteration, like=group) for group in self._muon_groups])
        self.clear()

    def gradients(self) -> list[Gradient]:
        """The gradients that the next step would apply."""
        return [
            Gradient(name, _group_of(name), parameter.grad)
            for name, parameter in self.scene.named_parameters()
            if parameter.grad is not None and parameter.grad.numel() > 0
        ]

    def limit(self, group: str, times: float, norm: float) -> None:
        """Clip the gradients of `group`: each entry to `times` its usual size, and all together to the norm `norm`.

        The usual size is the root of Adam's second moment as stored, so that `times` = 100 lets the moment grow 11-fold
        and shrinks the following steps to 30 %. For an entry of a matrix stepped by Muon it is the root mean square of
        the matrix's momentum: otherwise one entry would dominate the whole step. An entry with neither is clipped with
        its group only. So a single spike affects neither the later steps of its parameter nor those of its group.
        """
        momenta = dict(zip(self.muon.parameters, self.muon.momenta, strict=True))
        members = [p for one in self.adam.param_groups if one["name"] == group for p in one["params"]]
        members += [p for p, owner in zip(self.muon.parameters, self._muon_groups, strict=True) if owner == group]
        gradients: list[Tensor] = []
        for parameter in members:
            if parameter.grad is None:
                continue
            usual = self._usual_size(parameter, momenta.get(parameter))
            if usual is not None:
                most = torch.where(usual == 0, math.inf, times * usual)
                parameter.grad.clamp_(min=-most, max=most)
            gradients.append(parameter.grad)
        left = math.hypot(*(float(torch.linalg.vector_norm(gradient.double())) for gradient in gradients))
        if left > norm:
            # A power of two keeps every bit of the gradients, whatever the last bit of the norm.
            torch._foreach_mul_(gradients, 2.0 ** math.floor(math.log2(norm / left)))

    def _usual_size(self, parameter: nn.Parameter, momentum: Tensor | None) -> Tensor | None:
        """Usual size of the gradient of each entry of `parameter`; None before the first step."""
        if momentum is not None:
            return momentum.square().mean().sqrt()
        state = self.adam.state.get(parameter)
        return state["exp_avg_sq"].sqrt() if state else None

    def clear(self) -> None:
        """Drop all gradients."""
        for parameter in self.scene.parameters():
            parameter.grad = None

    def append(self, rows: dict[str, Tensor]) -> None:
        """Add anchors: `rows` holds new rows for every name in `Scaffold.ROWS`; their moments start at zero."""
        self._replace(lambda name, old: torch.cat([old, rows[name].to(old.dtype)]), _grow)

    def keep(self, mask: Bool[Tensor, " anchor"]) -> None:
        """Keep only the anchors where `mask` is true."""
        self._replace(lambda name, old: old[mask], lambda moment, _: moment[mask])

    def _replace(self, rows: Any, moments: Any) -> None:
        scaffold: Scaffold = self.scene.scaffold
        for name in Scaffold.ROWS:
            old = getattr(scaffold, name)
            if not isinstance(old, nn.Parameter):
                setattr(scaffold, name, rows(name, old))
                continue
            new = nn.Parameter(rows(name, old.detach()))
            setattr(scaffold, name, new)
            for group in self.adam.param_groups:
                group["params"] = [new if parameter is old else parameter for parameter in group["params"]]
            state = self.adam.state.pop(old, None)
            if state:
                for moment in ("exp_avg", "exp_avg_sq"):
                    state[moment] = moments(state[moment], new)
                self.adam.state[new] = state

    def state(self) -> dict[str, Tensor]:
        """What the next step depends on beside the parameters, by their names: moments and counts, or momenta."""
        momenta = dict(zip(self.muon.parameters, self.muon.momenta, strict=True))
        state: dict[str, Tensor] = {}
        for name, parameter in self.scene.named_parameters():
            for key, value in self.adam.state.get(parameter, {}).items():
                state[f"{name}/{key}"] = value
            if parameter in momenta:
                state[f"{name}/{MOMENTUM_OF}"] = momenta[parameter]
        return state

    def load(self, state: dict[str, Tensor]) -> None:
        """Continue from what `state()` returned for a scene of the same shape."""
        parameters = dict(self.scene.named_parameters())
        places = {parameter: place for place, parameter in enumerate(self.muon.parameters)}
        for key, value in state.items():
            name, _, field = key.rpartition("/")
            parameter = parameters[name]
            if field == MOMENTUM_OF:
                self.muon.momenta[places[parameter]] = value.clone()
            else:
                self.adam.state[parameter][field] = value.clone()


def _grow(moment: Tensor, new: Tensor) -> Tensor:
    return torch.cat([moment, moment.new_zeros((len(new) - len(moment), *moment.shape[1:]))])
