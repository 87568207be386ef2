"""Models of strangers: whatever is in the file is read or refused by a clear error, without much memory."""

from __future__ import annotations

import gzip
import json
import shutil
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from graings.errors import MAX_MESSAGE, CheckpointError
from graings.export.formats import read_splats
from graings.storage import compact
from graings.storage.checkpoint import TrainingState, load_state, load_training, save_checkpoint
from graings.storage.compact import read_compact, write_compact
from tests.export.models import tiny_model

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


def read_or_refused(file: Path, content: bytes) -> None:
    file.write_bytes(content)
    try:
        read_compact(file)
    except CheckpointError as error:
        clear = str(file) in str(error) and len(str(error)) <= MAX_MESSAGE + 3
        assert clear and printed(error)  # noqa: PT017, PT018


def test_any_value_of_any_fact_is_read_or_refused(packed: bytes, tmp_path: Path) -> None:
    facts = facts_of(packed)
    for key in facts:
        for value in STRANGE:
            read_or_refused(tmp_path / "a.graings", with_facts(packed, {**facts, key: value}))
    view = facts["views"]["train"][0]
    for key in view:
        for value in STRANGE:
            changed = {**facts, "views": {"train": [{**view, key: value}], "val": []}}
            read_or_refused(tmp_path / "a.graings", with_facts(packed, changed))
    for key in facts["sampling_rate"]:
        for value in (0, -1, 10**400, 1e308, "x", None):
            changed = {**facts, "sampling_rate": {**facts["sampling_rate"], key: value}}
            read_or_refused(tmp_path / "a.graings", with_facts(packed, changed))
        (tmp_path / "a.graings").write_bytes(
            with_facts(packed, {**facts, "sampling_rate": {**facts["sampling_rate"], key: 0}})
        )
        with pytest.raises(CheckpointError, match="sampling rates"):
            read_compact(tmp_path / "a.graings")
    for text in ("[" * 100_000, '{"a":' * 100_000, "NaN", "[]", "null", ""):
        read_or_refused(tmp_path / "a.graings", with_facts(packed, text))


def test_a_bomb_is_refused_before_it_fills_the_memory(
    packed: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compact, "_ANY_SIZE", 1 << 20)
    file = tmp_path / "a.graings"
    file.write_bytes(packed + gzip.compress(bytes(8 << 20)) * 4)
    with pytest.raises(CheckpointError, match="times its size"):
        read_compact(file)


def test_any_value_of_any_fact_of_a_checkpoint_is_read_or_refused(tmp_path: Path) -> None:
    model = tiny_model()
    folder = save_checkpoint(
        tmp_path,
        scene=model.scene,
        state=TrainingState({}, {"rates": [0.1]}),
        units=model.units,
        background=model.background,
        views=model.views,
        config=model.config,
        iteration=7,
        finished=True,
    )
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
