"""Files: written whole or not at all, and damage is named."""

import ast
import hashlib
import json
import math
import os
import pickle
import resource
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from safetensors.torch import save
from tensordict import TensorDict
from torch import nn

from magrl.files import (
    DamagedFileError,
    check_writable,
    json_ready,
    load_tensors,
    save_tensors,
    write_atomically,
    write_json,
    write_text,
    write_with,
)

ROOT = Path(__file__).parent.parent


def test_a_failed_write_leaves_the_old_file(tmp_path: Path, monkeypatch) -> None:
    path = tmp_path / "numbers.safetensors"
    save_tensors([1], path)

    def fail(*_) -> None:
        raise OSError("disk full")

    monkeypatch.setattr("os.replace", fail)
    with pytest.raises(OSError, match="disk full"):
        save_tensors([2], path)
    assert load_tensors(path) == [1]
    assert list(tmp_path.iterdir()) == [path]


def test_another_writer_of_the_same_file_does_not_disturb(tmp_path: Path, monkeypatch) -> None:
    path, sync = tmp_path / "file", os.fsync

    def write_another(handle: int) -> None:
        monkeypatch.undo()
        write_atomically(path, b"another")
        sync(handle)

    monkeypatch.setattr("os.fsync", write_another)
    write_atomically(path, b"one")
    assert path.read_bytes() == b"one"
    assert list(tmp_path.iterdir()) == [path]


TENSORS = st.builds(
    lambda dtype, shape: (torch.arange(math.prod(shape)) % 3).reshape(shape).to(dtype),
    st.sampled_from([torch.float32, torch.float64, torch.bfloat16, torch.int64, torch.uint8, torch.bool]),
    st.lists(st.integers(0, 3), max_size=3),
)
PLAIN = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=3) | TENSORS
KEYS = st.integers() | st.text(max_size=2) | st.sampled_from(["$tensor", "$dict", "a/b"])
CONTENT = st.recursive(
    PLAIN, lambda part: st.lists(part) | st.lists(part).map(tuple) | st.dictionaries(KEYS, part), max_leaves=8
)


def same(one: object, other: object) -> bool:
    if isinstance(one, torch.Tensor):
        return (one.dtype, one.shape) == (other.dtype, other.shape) and torch.equal(one, other)
    if isinstance(one, dict):
        return list(one) == list(other) and all(same(one[key], other[key]) for key in one)
    if isinstance(one, (list, tuple)):
        return type(one) is type(other) and len(one) == len(other) and all(map(same, one, other))
    return repr(one) == repr(other)  # NaN too


@given(CONTENT)
def test_content_is_read_as_it_was_written(tmp_path_factory, content: object) -> None:
    path = tmp_path_factory.getbasetemp() / "content.safetensors"
    save_tensors(content, path)
    assert same(load_tensors(path), content)


def test_state_dictionaries_keep_their_metadata(tmp_path: Path) -> None:
    """A TensorDict reads its batch size from it."""
    path, states = tmp_path / "state.safetensors", TensorDict(a=torch.ones(4, 2), batch_size=[4], device="cpu")
    for state in (states.state_dict(), nn.BatchNorm1d(2).state_dict()):
        save_tensors(state, path)
        loaded = load_tensors(path)
        assert same(dict(loaded), dict(state))
        assert loaded._metadata == state._metadata
    save_tensors(states.state_dict(), path)
    assert TensorDict().load_state_dict(load_tensors(path), strict=False).batch_size == (4,)


def test_views_of_one_tensor_are_written_as_their_values(tmp_path: Path) -> None:
    path, whole = tmp_path / "views.safetensors", torch.arange(6.0).reshape(2, 3)
    content = [whole, whole.T, whole[:, 1], torch.ones(1).expand(4), whole]
    save_tensors(content, path)
    assert same(load_tensors(path), content)


class Allocate:
    """Take 3 GB when it is unpickled, which ``torch.load(weights_only=True)`` allows."""

    def __reduce__(self) -> tuple:
        return bytearray, (3_000_000_000,)


def test_what_this_library_did_not_write_is_named_and_takes_no_memory(tmp_path: Path) -> None:
    path = tmp_path / "weights.safetensors"
    torch.save({"format": Allocate()}, path)
    files = [path.read_bytes(), pickle.dumps(Allocate()), save({"a": torch.ones(2)}), b"", bytes(8) + b"{"]
    save_tensors({"a": torch.ones(2)}, path)
    whole, deep = path.read_bytes(), b'{"__metadata__":{"magrl":"' + b"[" * 100_000
    files += [whole[:-1], whole + b"0", len(deep).to_bytes(8, "little") + deep, b"\xff" * 8 + whole[8:]]
    for content in files:
        path.write_bytes(content)
        tracemalloc.start()
        with pytest.raises(DamagedFileError, match=f"^{path} is damaged: ") as error:
            load_tensors(path)
        assert tracemalloc.get_traced_memory()[1] < 2_000_000
        tracemalloc.stop()
        assert "\n" not in str(error.value)
    with pytest.raises(DamagedFileError, match="nowhere is damaged: "):
        load_tensors(tmp_path / "nowhere")


def test_what_a_forged_file_may_say_is_bounded_by_its_size(tmp_path: Path) -> None:
    """A tensor stands in one place, so that thousands of names do not multiply the work on a large one."""
    path, one, zeros = tmp_path / "forged.safetensors", {"$tensor": "a"}, "0" * 64
    for tree, message in (
        ([one, one], "'a'"),
        ({"$tuple": 5}, "not iterable"),
        ({"$dict": [[[], 1]], "metadata": 1}, "unhashable"),
    ):
        body = save({"a": torch.ones(2)}, {"magrl": json.dumps({"sha256": zeros, "content": tree})})
        path.write_bytes(body.replace(zeros.encode(), hashlib.sha256(body).hexdigest().encode(), 1))
        with pytest.raises(DamagedFileError, match=f"^{path} is damaged: .*{message}"):
            load_tensors(path)


def test_only_plain_data_is_written(tmp_path: Path) -> None:
    for content in (object(), {1, 2}, [torch.dtype], {"a": b"text"}):
        with pytest.raises(TypeError, match="not JSON serializable"):
            save_tensors(content, tmp_path / "file")
    assert list(tmp_path.iterdir()) == []


def test_json_holds_no_infinity() -> None:
    assert json_ready({"a": [math.inf, (1.5, math.nan)], "b": "nan"}) == {"a": [None, [1.5, None]], "b": "nan"}


def test_files_are_written_whole() -> None:
    """The library and the recipes write by magrl.files alone."""
    direct = []
    for path in (file for folder in ("magrl", "recipes") for file in (ROOT / folder).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
                own = {"write_text": True, "savefig": True, "to_csv": node.args}
                direct += [f"{path}:{node.lineno}"] if own.get(node.func.attr) else []
    assert direct == []


LEAST_BYTES = 2000
LONG = "°" * LEAST_BYTES
WRITERS: dict[str, Callable[[Path], None]] = {
    "bytes": lambda path: write_atomically(path, LONG.encode()),
    "text": lambda path: write_text(path, LONG),
    "JSON": lambda path: write_json(path, {"a": LONG}),
    "tensors": lambda path: save_tensors(torch.ones(LEAST_BYTES), path),
    "another library": lambda path: write_with(path, Path.write_text, LONG, encoding="utf-8"),
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk_names_the_file_and_leaves_it_as_it_was(name: str, tmp_path: Path) -> None:
    path, limits = tmp_path / "file.txt", resource.getrlimit(resource.RLIMIT_FSIZE)
    path.write_text("old", encoding="utf-8")
    resource.setrlimit(resource.RLIMIT_FSIZE, (LEAST_BYTES // 2, limits[1]))  # the first part still has room
    try:
        with pytest.raises(OSError, match=f"^cannot write {path}: .*(large|space)"):
            WRITERS[name](path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert [each.read_text("utf-8") for each in tmp_path.iterdir()] == ["old"]


def test_check_writable_makes_folders_and_keeps_files(tmp_path: Path) -> None:
    """And links, also one to nothing."""
    (tmp_path / "old.html").write_text("kept", encoding="utf-8")
    for link, end in {"link": "old.html", "dangling": "none"}.items():
        (tmp_path / link).symlink_to(end)
    for name in ("old.html", "link", "dangling"):
        check_writable(tmp_path / name)
    assert (tmp_path / "old.html").read_text(encoding="utf-8") == "kept"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["dangling", "link", "old.html"]
    check_writable(tmp_path / "new" / "page.html")
    assert list((tmp_path / "new").iterdir()) == []
    with pytest.raises(OSError, match=r"cannot write .*old\.html/page\.html"):
        check_writable(tmp_path / "old.html" / "page.html")
