"""Checkpoints: what is written comes back, and what is damaged is never believed."""

import signal
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from conftest import limited_file_size

from jaxpend import JaxpendError
from jaxpend.runs.checkpoints import Checkpoints


def tree(number):
    """All that states are made of."""
    params = {"w": jnp.full((300, 40), number / 3), "b": jnp.zeros(2, jnp.int32)}
    return {
        "opt": optax.adam(0.1).init(params),
        "key": jax.random.key(number),
        "keys": jax.random.split(jax.random.key(number), 3),
        "none": None,
        "noise": jax.random.normal(jax.random.key(number), (5000,)),
        "params": params,
    }


def written(folder, numbers, keep=2):
    """Checkpoints of some trees."""
    checkpoints = Checkpoints(folder, keep)
    for number in numbers:
        checkpoints.save(tree(number), {"number": number})
    return checkpoints


def newest(checkpoints):
    """The newest good one, after checking that it is what was written."""
    found, about = checkpoints.newest(lambda about: jax.eval_shape(tree, about["number"]))
    expected = tree(about["number"])
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert a.dtype == b.dtype
        is_key = jnp.issubdtype(a.dtype, jax.dtypes.prng_key)
        np.testing.assert_array_equal(*map(jax.random.key_data, (a, b)) if is_key else (a, b))
    return about["number"]


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_what_is_written_comes_back_and_the_last_ones_are_kept(tmp_path, capfd):
    assert Checkpoints(tmp_path / "none").newest(lambda _: None) is None
    assert not (tmp_path / "none").exists()
    checkpoints = written(tmp_path / "a", range(1, 5))
    assert newest(checkpoints) == 4
    assert names(tmp_path / "a") == ["000003.npz", "000004.npz"]
    Checkpoints(tmp_path / "a", 1).save(tree(7), {"number": 7})
    assert names(tmp_path / "a") == ["000005.npz"]
    checkpoints.clear()
    assert not (tmp_path / "a").exists()
    assert capfd.readouterr() == ("", "")


def test_a_process_killed_while_it_writes_leaves_what_there_was(tmp_path, capfd):
    code = """
import os, signal, sys
import jax.numpy as jnp
from jaxpend.runs.checkpoints import Checkpoints
checkpoints = Checkpoints(sys.argv[1])
checkpoints.save({"x": jnp.arange(3.0)}, {"number": 1})
os.replace = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
checkpoints.save({"x": jnp.arange(3.0) + 1}, {"number": 2})
"""
    done = subprocess.run([sys.executable, "-c", code, tmp_path / "a"])
    assert done.returncode == -signal.SIGKILL
    first, unfinished = sorted(names(tmp_path / "a"), reverse=True)
    assert (first, unfinished[:24]) == ("000001.npz", ".000002.npz.jaxpend-tmp-")
    checkpoints = Checkpoints(tmp_path / "a")
    found, about = checkpoints.newest(lambda _: {"x": jax.ShapeDtypeStruct((3,), jnp.float32)})
    np.testing.assert_array_equal(found["x"], np.arange(3.0))
    assert about == {"number": 1}
    checkpoints.save(tree(2), {"number": 2})
    assert names(tmp_path / "a") == ["000001.npz", "000002.npz"]
    assert capfd.readouterr() == ("", "")


def test_files_of_others_in_the_folder_stay(tmp_path):
    others = ("mine.npz", "17", "00000a.npz", "1000000.npz", ".000001.npz.1234", "notes.txt")
    (tmp_path / "a" / "000009").mkdir(parents=True)
    for name in others:
        (tmp_path / "a" / name).write_text("mine")
    checkpoints = written(tmp_path / "a", range(1, 5))
    assert newest(checkpoints) == 4
    checkpoints.clear()
    assert names(tmp_path / "a") == sorted((*others, "000009"))


def truncate(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def flip(path):
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


@pytest.mark.parametrize("harm", [truncate, flip, lambda path: path.write_bytes(b"")])
def test_a_damaged_checkpoint_is_passed_over_with_a_warning(tmp_path, capfd, harm):
    checkpoints = written(tmp_path / "a", (1, 2))
    harm(tmp_path / "a" / "000002.npz")
    assert newest(checkpoints) == 1
    out, err = capfd.readouterr()
    assert out == ""
    assert "000002.npz is damaged; using the one before it" in err
    assert len(err.splitlines()) == 1
    checkpoints.save(tree(3), {"number": 3})
    assert newest(checkpoints) == 3
    harm(tmp_path / "a" / "000003.npz")
    with pytest.raises(JaxpendError, match=r"no checkpoint in .* is whole; choose another name"):
        newest(checkpoints)


def test_no_byte_of_a_checkpoint_can_change_what_is_read(tmp_path, monkeypatch):
    """Wherever a file is damaged: either what was written is read, or nothing."""
    monkeypatch.setattr("jaxpend.runs.checkpoints.console.print", lambda *_, **__: None)
    checkpoints = Checkpoints(tmp_path)
    written = {"w": jnp.arange(6.0).reshape(2, 3), "key": jax.random.key(3)}
    checkpoints.save(written, {"number": 1})
    (path,) = tmp_path.iterdir()
    content, refused = path.read_bytes(), 0
    for k in range(len(content)):
        damaged = bytearray(content)
        damaged[k] ^= 1 << k % 8
        path.write_bytes(damaged)
        try:
            found, about = checkpoints.newest(lambda _: written)
        except JaxpendError:
            refused += 1
            continue
        assert about == {"number": 1}
        np.testing.assert_array_equal(found["w"], written["w"])
        np.testing.assert_array_equal(*(jax.random.key_data(t["key"]) for t in (found, written)))
    assert refused > len(content) / 2


def test_a_checkpoint_of_other_arrays_is_not_believed(tmp_path, capfd):
    checkpoints = written(tmp_path, (1,))
    other = jax.eval_shape(lambda: tree(1) | {"params": {"v": jnp.zeros(3), "b": jnp.zeros(2)}})
    with pytest.raises(JaxpendError, match="no checkpoint"):
        checkpoints.newest(lambda _: other)


def test_a_full_disk_is_one_sentence_and_leaves_what_there_was(tmp_path, capfd):
    checkpoints = written(tmp_path / "a", (1, 2))
    big = tree(3) | {"noise": list(jax.random.normal(jax.random.key(0), (9, 100_000)))}
    with limited_file_size(50_000), pytest.raises(JaxpendError) as error:
        checkpoints.save(big, {"number": 3})
    text = str(error.value)
    assert text == f"cannot write a checkpoint to {tmp_path / 'a'}: File too large"
    assert names(tmp_path / "a") == ["000001.npz", "000002.npz"]
    assert newest(checkpoints) == 2
    assert capfd.readouterr() == ("", "")
