"""Random streams and view sampling."""

from __future__ import annotations

import torch

from graings.random import RandomStreams
from graings.training.view_sampler import ViewSampler


def test_streams_do_not_disturb_each_other() -> None:
    alone, mixed = RandomStreams(3), RandomStreams(3)
    torch.rand(100, generator=mixed["other"])
    assert torch.equal(torch.rand(5, generator=alone["growth"]), torch.rand(5, generator=mixed["growth"]))
    assert not torch.equal(
        torch.rand(5, generator=RandomStreams(4)["growth"]), torch.rand(5, generator=RandomStreams(3)["growth"])
    )


def test_a_stream_continues_where_its_state_was_taken() -> None:
    streams = RandomStreams(0)
    torch.rand(7, generator=streams["a"])
    state = {name: value.clone() for name, value in streams.state().items()}
    expected = torch.rand(5, generator=streams["a"])
    fresh = RandomStreams(0)
    fresh.load(state)
    assert torch.equal(torch.rand(5, generator=fresh["a"]), expected)


def test_every_view_is_drawn_once_per_round_in_a_new_order() -> None:
    sampler = ViewSampler(7, RandomStreams(0)["sampler"])
    rounds = [[sampler.next() for _ in range(7)] for _ in range(3)]
    assert all(sorted(order) == list(range(7)) for order in rounds)
    assert rounds[0] != rounds[1]


def test_a_stream_that_was_not_used_by_then_begins_again_after_a_load() -> None:
    streams = RandomStreams(3)
    torch.rand(2, generator=streams["early"])
    state = streams.state()
    expected = torch.rand(4, generator=RandomStreams(3)["late"])
    held = streams["late"]
    torch.rand(7, generator=held)
    streams.load(state)
    assert torch.equal(torch.rand(4, generator=held), expected)
