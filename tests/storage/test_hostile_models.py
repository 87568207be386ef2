"""Models of strangers: whatever is in the file is read or refused by a clear error, without much memory."""

from __future__ import annotations

import gzip
import json
import shutil
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from graings.errors import MAX_MESSAGE, CheckpointError
from graings.export.formats import read_splats
from graings.render import render
from graings.scene.prepared import PreparedScene
from graings.storage import compact
from graings.storage.checkpoint import load_model, load_state, load_training
from graings.storage.compact import read_compact, write_compact
from tests.export.models import tiny_model
from tests.storage.checkpoints import save

STRANGE = (None, True, -1, 0, 1.5, 10**400, "x", "x" * 9_000, "\ud800", [], {}, [[]], [None], 2**63, 1e308)


def with_facts(packed: bytes, facts: Any) -> bytes:
    """The compact file with other facts."""
    data = gzip.decompress(packed)
    size = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + size])
    header["__metadata__"]["graings"] = json.dumps(facts) if not isinstance(facts, str) else facts
    text = json.dumps(header).encode()
    return gzip.compress(struct.pack("<Q", len(text)) + text + data[8 + size :], 1)


def facts_of(packed: bytes) -> dict[str, Any]:
    data = gzip.decompress(packed)
    header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
    facts: dict[str, Any] = json.loads(header["__metadata__"]["graings"])
    return facts


@pytest.fixture(scope="module")
def packed(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    file = tmp_path_factory.mktemp("seed") / "seed.graings"
    write_compact(tiny_model(), file)
    return file.read_bytes()


def printed(error: Exception) -> bool:
    """Whether the message prints; torch breaks the lines of its own."""
    return str(error).replace("\n", "").isprintable()


def rendered_or_refused(file: Path, content: bytes) -> bool:
    """Whether the model is read; then it also renders: a small view of its first camera at that view's time."""
    file.write_bytes(content)
    try:
        model = read_compact(file)
    except CheckpointError as error:
        clear = str(file) in str(error) and len(str(error)) <= MAX_MESSAGE + 3
        assert clear and printed(error)  # noqa: PT017, PT018
        return False
    for view in (*model.views.get("train", ()), *tiny_model().views["train"])[:1]:
        camera = replace(view.camera, width=8, height=8)
        result = render(PreparedScene(model.scene), camera, view.time, model.background)
        assert result.color.shape == (8, 8, 3)
    return True


def test_any_value_of_any_fact_is_read_or_refused(packed: bytes, tmp_path: Path) -> None:
    facts = facts_of(packed)
    for key in facts:
        for value in STRANGE:
            rendered_or_refused(tmp_path / "a.graings", with_facts(packed, {**facts, key: value}))
    view = facts["views"]["train"][0]
    for key in view:
        for value in STRANGE:
            changed = {**facts, "views": {"train": [{**view, key: value}], "val": []}}
            rendered_or_refused(tmp_path / "a.graings", with_facts(packed, changed))
    for key in facts["sampling_rate"]:
        for value in (0, -1, 10**400, 1e308, "x", None):
            changed = {**facts, "sampling_rate": {**facts["sampling_rate"], key: value}}
            rendered_or_refused(tmp_path / "a.graings", with_facts(packed, changed))
        (tmp_path / "a.graings").write_bytes(
            with_facts(packed, {**facts, "sampling_rate": {**facts["sampling_rate"], key: 0}})
        )
        with pytest.raises(CheckpointError, match="sampling rates"):
            read_compact(tmp_path / "a.graings")
    for text in ("[" * 100_000, '{"a":' * 100_000, "NaN", "[]", "null", ""):
        rendered_or_refused(tmp_path / "a.graings", with_facts(packed, text))


@pytest.mark.parametrize(
    ("key", "value"),
    [
        *(("background", value) for value in ([1], [0, 0, "x"], [0, 0, 0, 0], [0, 0, 1e999])),
        *(("temporal", value) for value in (1, None, "yes")),
        *(("iteration", value) for value in (1.5, True, None)),
        *(("size", value) for value in ([8.5, 8.5], [8, 10**6], [8], [0, 8], ["8", 8])),
        *(("time", value) for value in ("x", None, True, 1e999)),
        *(("name", value) for value in (None, 3)),
        *(("scale", value) for value in (0, -1, 1e999)),
        *(("center", value) for value in ([0, 0], [0, 0, None])),
    ],
)
def test_a_wrong_fact_is_refused(packed: bytes, tmp_path: Path, key: str, value: Any) -> None:
    facts = facts_of(packed)
    view, units = facts["views"]["train"][0], facts["units"]
    if key in view:
        facts["views"]["train"][0] = {**view, key: value}
    elif key in units:
        facts["units"] = {**units, key: value}
    else:
        assert key in facts
        facts[key] = value
    assert not rendered_or_refused(tmp_path / "a.graings", with_facts(packed, facts))


@pytest.mark.parametrize("name", ["anchors", "uids", "log_scales", "features", "offsets", "opacity_offsets", "extent"])
def test_tensors_of_another_shape_are_refused(tmp_path: Path, name: str) -> None:
    for change in (lambda t: t[:-1], lambda t: t[..., :-1], lambda t: t[..., :0], lambda t: t.unsqueeze(-1)):
        model = tiny_model()
        owner = model.scene if name == "extent" else model.scene.scaffold
        old = getattr(owner, name)
        new = old.detach().expand(2) if name == "extent" else change(old.detach())
        if isinstance(old, torch.nn.Parameter):
            new = torch.nn.Parameter(new)
        setattr(owner, name, new)
        folder = save(model, tmp_path / f"{name}{new.shape}")
        with pytest.raises(CheckpointError, match="damaged checkpoint"):
            load_model(folder)


@pytest.mark.parametrize("extent", [0.0, -1.0, float("nan"), float("inf")])
def test_an_extent_that_no_scene_has_is_refused(tmp_path: Path, extent: float) -> None:
    model = tiny_model()
    model.scene.extent.fill_(extent)
    with pytest.raises(CheckpointError, match="extent"):
        load_model(save(model, tmp_path))


@pytest.mark.parametrize("file", ["scene.safetensors", "state.safetensors"])
def test_a_flipped_bit_is_noticed_and_an_earlier_checkpoint_is_used(tmp_path: Path, file: str) -> None:
    model = tiny_model()
    earlier, newer = (save(model, tmp_path, iteration) for iteration in (7, 8))
    damaged = bytearray((newer / file).read_bytes())
    damaged[-3] ^= 1
    (newer / file).write_bytes(damaged)
    assert load_training(tmp_path)[0].path == earlier
    with pytest.raises(CheckpointError, match="damaged"):
        load_training(newer)


def test_a_bomb_is_refused_before_it_fills_the_memory(
    packed: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compact, "_ANY_SIZE", 1 << 20)
    file = tmp_path / "a.graings"
    file.write_bytes(packed + gzip.compress(bytes(8 << 20)) * 4)
    with pytest.raises(CheckpointError, match="times its size"):
        read_compact(file)


def test_any_value_of_any_fact_of_a_checkpoint_is_rendered_or_refused(tmp_path: Path) -> None:
    folder = save(tiny_model(), tmp_path)
    file = folder / "checkpoint.json"
    facts = json.loads(file.read_text())
    contents = [json.dumps({**facts, key: value}) for key in facts for value in STRANGE]
    for content in (*contents, "[" * 100_000, "[]", "1", "\x00"):
        file.write_text(content)
        try:
            load_training(folder)
            load_state(folder)
        except CheckpointError as error:
            assert printed(error)  # noqa: PT017
    shutil.rmtree(folder)


@pytest.mark.parametrize("name", ["f_rest_x", "f_rest_99", "f_rest_-1", "f_rest_"])
def test_splats_with_a_harmonic_of_another_name_are_refused(tmp_path: Path, name: str) -> None:
    names = [*"xyz", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{i}" for i in range(8)), name, "opacity"]
    names += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 2\n"
    head += "".join(f"property float {each}\n" for each in names) + "end_header\n"
    (tmp_path / "a.ply").write_bytes(head.encode() + np.ones((2, len(names)), "<f4").tobytes())
    with pytest.raises(CheckpointError, match="f_rest"):
        read_splats(tmp_path / "a.ply")
