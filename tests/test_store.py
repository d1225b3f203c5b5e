"""The store finds what was made, makes what was not, and survives damage."""

import pytest
import torch

from neural_sim.store import Store, _without_docstrings, code_version, digest, tensor_digest


def test_made_once_then_found(tmp_path):
    store, calls = Store(tmp_path), []

    def make():
        calls.append(1)
        return {"x": torch.arange(3)}

    first = store.fetch("field", {"a": 1}, make)
    second = store.fetch("field", {"a": 1}, make)
    assert len(calls) == 1 and not first.found and second.found
    assert torch.equal(second.value["x"], torch.arange(3))
    assert second.seconds == first.seconds
    store.fetch("field", {"a": 2}, make)
    assert len(calls) == 2


def test_a_damaged_entry_is_made_again(tmp_path, caplog):
    store = Store(tmp_path)
    entry = store.fetch("field", {"a": 1}, lambda: 1)
    (tmp_path / "field" / f"{entry.key}.pt").write_bytes(b"half written")
    assert store.fetch("field", {"a": 1}, lambda: 2).value == 2
    assert "made again" in caplog.text


def test_a_failed_make_leaves_nothing(tmp_path):
    with pytest.raises(RuntimeError):
        Store(tmp_path).fetch("field", {"a": 1}, lambda: (_ for _ in ()).throw(RuntimeError("no")))
    assert not list(tmp_path.rglob("*.pt"))


def test_key_ignores_the_order_of_keys_and_refuses_objects():
    assert digest({"a": 1, "b": [1, 2]}) == digest({"b": [1, 2], "a": 1})
    assert digest({"a": 1}) != digest({"a": 1.5})
    with pytest.raises(TypeError):
        digest({"a": object()})


def test_tensor_digest_sees_values_shapes_and_types():
    x = torch.arange(4.0)
    assert tensor_digest([x]) == tensor_digest([x.clone()])
    seen = {tensor_digest([y]) for y in (x, x.double(), x.reshape(2, 2), x + 1)}
    assert len(seen) == 4


def test_code_version_ignores_prose_only():
    import ast

    def version(source):
        return ast.dump(_without_docstrings(ast.parse(source)))

    base = 'def f(x):\n    "Doc."\n    return x + 1\n'
    assert version(base) == version('def f(x):\n    "Other."\n    # why\n    return x + 1\n')
    assert version(base) != version('def f(x):\n    "Doc."\n    return x + 2\n')
    assert code_version("parameter") != code_version("store")
