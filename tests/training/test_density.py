"""Growth and pruning bookkeeping: Eq. 6 and what follows it."""

from __future__ import annotations

import math

import pytest
import torch

from graings.config import DensityConfig, TrainConfig
from graings.report.events import Pruned
from graings.scene.scaffold import Scaffold
from graings.training.density.control import DensityControl
from graings.training.density.growth import grow, new_anchor_opacity_offsets, prune, thin_out, voxel_keys
from graings.training.density.statistics import DensityStatistics
from graings.training.optimizer import Optimizer
from tests.models import EYE, tiny_scene

VOXEL = 0.01


def _grow(scaffold: Scaffold, statistics: DensityStatistics, **config: object) -> object:
    logits = torch.ones(scaffold.count, scaffold.slots) + scaffold.opacity_offsets.detach().unsqueeze(-1)
    generator = torch.Generator().manual_seed(0)
    return grow(scaffold, statistics, logits, DensityConfig(**config), VOXEL, 100, generator)


def _busy(scaffold: Scaffold, gradient: float = 1.0, times: int = 50) -> DensityStatistics:
    statistics = DensityStatistics(scaffold.count, scaffold.slots)
    statistics.gradient.fill_(gradient * times)
    statistics.drawn.fill_(times)
    return statistics


def test_gradients_are_counted_in_ndc_units_and_only_for_visible_children() -> None:
    statistics = DensityStatistics(2, 3)
    children = torch.tensor([0, 2, 4])
    gradient = torch.tensor([[3.0, 0.0], [0.0, 4.0], [1.0, 1.0]])
    opacities = torch.tensor([[0.5, -0.5, 0.25], [-0.1, 0.3, -0.1]])
    statistics.observe(children, gradient, torch.tensor([True, True, False]), opacities, (20, 10))
    assert statistics.gradient.tolist() == [[30.0, 0.0, 20.0], [0.0, 0.0, 0.0]]
    assert statistics.drawn.tolist() == [[1, 0, 1], [0, 0, 0]]
    assert statistics.visits.tolist() == [1, 0]
    assert statistics.opacity.tolist() == [0.75, 0.0]


def test_an_anchor_with_no_visible_opacity_counts_as_visited() -> None:
    statistics = DensityStatistics(1, 2)
    nothing = torch.zeros(0, dtype=torch.int64)
    statistics.observe(
        nothing, torch.zeros(0, 2), torch.zeros(0, dtype=torch.bool), torch.tensor([[-0.2, 0.001]]), (8, 8)
    )
    assert statistics.visits.tolist() == [1]


def test_children_observed_too_rarely_or_with_small_gradients_do_not_grow() -> None:
    scaffold = tiny_scene().scaffold
    assert len(_grow(scaffold, _busy(scaffold, times=40))) == 0
    assert len(_grow(scaffold, _busy(scaffold, gradient=1.9e-4))) == 0
    assert len(_grow(scaffold, _busy(scaffold, gradient=3e-4))) > 0


def test_new_anchors_sit_on_free_cells_inherit_features_and_start_with_zero_offsets() -> None:
    scaffold = tiny_scene(anchors=40).scaffold
    with torch.no_grad():  # ten anchors whose children lie in the same cells, but not in their own anchor's
        for rows in (scaffold.anchors, scaffold.log_scales, scaffold.offsets):
            rows[:10] = rows[0].clone()
    growth = _grow(scaffold, _busy(scaffold), levels=1)
    rows = growth.rows
    keys = voxel_keys(rows["anchors"], VOXEL)
    assert torch.allclose(rows["anchors"].double(), keys.double() * VOXEL, atol=1e-6)
    occupied = {tuple(key) for key in voxel_keys(scaffold.anchors, VOXEL).tolist()}
    assert len({tuple(key) for key in keys.tolist()}) == len(growth)
    assert not occupied & {tuple(key) for key in keys.tolist()}
    assert torch.count_nonzero(rows["offsets"]) == 0
    assert rows["uids"].tolist() == list(range(100, 100 + len(growth)))
    assert torch.allclose(rows["log_scales"], torch.tensor(math.log(VOXEL)))
    # Of all children half are candidates; a new anchor has the largest of each feature among those in its cell.
    children = (scaffold.anchors[:, None] + scaffold.log_scales.exp()[:, None] * scaffold.offsets).flatten(0, 1)
    candidate = torch.rand(len(children), generator=torch.Generator().manual_seed(0)) > 0.5
    parents = []
    for key, features in zip(keys, rows["features"], strict=True):
        inside = candidate & (voxel_keys(children, VOXEL) == key).all(dim=1)
        owners = inside.nonzero().squeeze(-1) // scaffold.slots
        assert torch.equal(features, scaffold.features[owners].amax(dim=0))
        parents.append(len(owners))
    assert min(parents) == 1
    assert max(parents) > 3


def test_growing_twice_from_the_same_statistics_adds_nothing_in_the_same_cells() -> None:
    scene = tiny_scene(anchors=40)
    optimizer = Optimizer(scene, TrainConfig(), joint_from=0)
    first = _grow(scene.scaffold, _busy(scene.scaffold), levels=1)
    optimizer.append(first.rows)
    before = {tuple(key) for key in voxel_keys(scene.scaffold.anchors, VOXEL).tolist()}
    second = _grow(scene.scaffold, _busy(scene.scaffold), levels=1)
    assert not before & {tuple(key) for key in voxel_keys(second.rows["anchors"], VOXEL).tolist()}


def test_finer_levels_need_larger_gradients() -> None:
    scaffold, least = tiny_scene(anchors=200).scaffold, DensityConfig().gradient_threshold
    coarse = _grow(scaffold, _busy(scaffold, gradient=1.5 * least), levels=2).rows["log_scales"].unique()
    both = _grow(scaffold, _busy(scaffold, gradient=2.5 * least), levels=2).rows["log_scales"].unique()
    assert torch.allclose(coarse, torch.tensor([math.log(4 * VOXEL)]))
    assert len(both) == 2


def test_the_budget_keeps_the_largest_gradients() -> None:
    scaffold = tiny_scene(anchors=200).scaffold
    statistics = _busy(scaffold)
    statistics.gradient *= torch.arange(1, 201).unsqueeze(-1)
    free = _grow(scaffold, statistics, levels=1)
    tight = _grow(scaffold, statistics, levels=1, max_anchors=210)
    assert len(tight) == 10
    assert tight.capped
    assert not free.capped
    mean = tight.rows["anchors"].mean(0)
    assert torch.allclose(mean, scaffold.anchors[-20:].mean(0), atol=0.3)


def test_thinning_keeps_the_largest_gradients_and_enlarges_the_rest() -> None:
    scaffold = tiny_scene(anchors=200).scaffold
    statistics = _busy(scaffold, gradient=0.1)
    asking = torch.tensor([3, 50, 170, 199])
    statistics.gradient[asking, 1] *= 5  # one child is enough
    statistics.drawn[7] = 0  # never seen
    statistics.gradient[7] = 0
    keep, wider = thin_out(scaffold, statistics, 40, torch.Generator().manual_seed(0))
    assert int(keep.sum()) == 40
    assert keep[asking].all()
    assert torch.count_nonzero(wider[asking]) == 0
    widened = wider > 0
    assert (int(widened.sum()), bool(keep[widened].all())) == (20, True)
    # A hundred and eighty are replaced by twenty, so that their area is that of all.
    assert torch.allclose(wider[widened].mul(2).exp().sum(), torch.tensor(180.0))
    again = thin_out(scaffold, statistics, 40, torch.Generator().manual_seed(0))
    assert torch.equal(keep, again[0])


def test_new_anchors_are_faint_or_inherit_their_opacity_as_configured() -> None:
    scaffold = tiny_scene().scaffold
    logits = torch.full((scaffold.count, 3), 1.0)
    parents = torch.tensor([0, 5])
    faint = new_anchor_opacity_offsets(scaffold, logits, parents, 0.05)
    assert torch.allclose(torch.tanh(logits[parents].amax(-1) + faint), torch.tensor(0.05))
    assert torch.equal(new_anchor_opacity_offsets(scaffold, logits, parents, None), scaffold.opacity_offsets[parents])
    fainter = new_anchor_opacity_offsets(scaffold, logits - 3.0, parents, 0.05)
    assert torch.equal(fainter, scaffold.opacity_offsets.detach()[parents])


def test_with_an_offset_for_each_child_all_children_of_a_new_anchor_start_faint() -> None:
    scaffold = tiny_scene().scaffold
    own = torch.randn(scaffold.count, 3)
    scaffold = Scaffold(scaffold.anchors, scaffold.log_scales.data, scaffold.features.data, scaffold.offsets.data, own)
    network = torch.randn(scaffold.count, 3)
    parents = torch.tensor([0, 5])
    faint = new_anchor_opacity_offsets(scaffold, network + own, parents, 0.1)
    torch.testing.assert_close(torch.tanh(network[parents] + faint), torch.full((2, 3), 0.1))
    assert torch.equal(new_anchor_opacity_offsets(scaffold, network + own, parents, None), own[parents])


@pytest.mark.parametrize("shape", [(19,), (20, 2), (20, 3, 1), ()])
def test_opacity_offsets_of_another_shape_are_refused(shape: tuple[int, ...]) -> None:
    scaffold = tiny_scene().scaffold
    rows = (scaffold.anchors, scaffold.log_scales.data, scaffold.features.data, scaffold.offsets.data)
    with pytest.raises(ValueError, match="opacity_offsets"):
        Scaffold(*rows, torch.zeros(shape))


def test_pruning_removes_only_well_observed_faint_anchors() -> None:
    scaffold = tiny_scene().scaffold
    statistics = DensityStatistics(20, 3)
    statistics.visits.fill_(100)
    statistics.opacity.fill_(100.0)
    statistics.opacity[3] = 0.1
    statistics.opacity[4] = 0.1
    statistics.visits[4] = 10
    assert (~prune(scaffold, statistics, DensityConfig())).nonzero().flatten().tolist() == [3]


def test_pruning_never_empties_the_scene() -> None:
    scaffold = tiny_scene().scaffold
    statistics = DensityStatistics(20, 3)
    statistics.visits.fill_(100)
    assert bool(prune(scaffold, statistics, DensityConfig()).all())


def test_an_anchor_that_has_faded_is_pruned_at_the_second_pruning() -> None:
    scene = tiny_scene()
    config = TrainConfig()
    control = DensityControl(config, scene, VOXEL)
    optimizer = Optimizer(scene, config, joint_from=0)
    opacities = torch.full((20, 3), 0.5)
    for faded in (False, True):
        opacities[3] = -0.5 if faded else 0.5
        drawn = (opacities > 0).flatten().nonzero().squeeze(-1)
        for _ in range(config.density.prune_min_views + 1):
            control.statistics.observe(
                drawn, torch.zeros(len(drawn), 2), torch.ones(len(drawn), dtype=torch.bool), opacities, (8, 8)
            )
        assert control.prune(7, scene, optimizer) == ([Pruned(iteration=7, anchors=1)] if faded else [])
    assert 3 not in scene.scaffold.uids.tolist()


def test_rows_moments_and_statistics_stay_aligned_through_growth_and_pruning() -> None:
    scene = tiny_scene(anchors=30)
    optimizer = Optimizer(scene, TrainConfig(), joint_from=0)
    statistics = DensityStatistics(30, 3)
    scene.compose(EYE, 0.4).gaussians.means.square().sum().backward()
    optimizer.step(1)
    uids = scene.scaffold.uids.clone()
    moments = optimizer.adam.state[scene.scaffold.offsets]["exp_avg"].clone()
    statistics.drawn += torch.arange(30).unsqueeze(-1)

    growth = _grow(scene.scaffold, _busy(scene.scaffold))
    optimizer.append(growth.rows)
    statistics.resize(append=len(growth))
    keep = torch.ones(30 + len(growth), dtype=torch.bool)
    keep[[2, 7, 31]] = False
    optimizer.keep(keep)
    statistics.resize(keep=keep)

    old = [i for i in range(30) if i not in (2, 7)]
    assert scene.scaffold.count == 30 + len(growth) - 3 == len(statistics.drawn)
    assert scene.scaffold.uids[:28].tolist() == uids[old].tolist()
    assert len(scene.scaffold.uids.unique()) == scene.scaffold.count
    assert torch.equal(optimizer.adam.state[scene.scaffold.offsets]["exp_avg"][:28], moments[old])
    assert torch.count_nonzero(optimizer.adam.state[scene.scaffold.offsets]["exp_avg"][28:]) == 0
    assert statistics.drawn[:28, 0].tolist() == old
    assert torch.count_nonzero(statistics.drawn[28:]) == 0
    scene.compose(EYE, 0.4).gaussians.means.square().sum().backward()
    optimizer.step(2)


def test_voxel_keys_survive_far_coordinates() -> None:
    far = torch.tensor([[123456.7890625, 0.0, -123456.7890625]], dtype=torch.float64)
    assert voxel_keys(far, 1e-5).tolist() == [[12345678906, 0, -12345678906]]
