"""Checkpoints: what is written comes back, and what is damaged is never believed."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from conftest import limited_file_size

from jaxpend import JaxpendError
from jaxpend.runs.checkpoints import MANIFEST, Checkpoints


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


def test_what_is_written_comes_back_and_the_last_ones_are_kept(tmp_path, capfd):
    assert Checkpoints(tmp_path / "none").newest(lambda _: None) is None
    assert not (tmp_path / "none").exists()
    checkpoints = written(tmp_path / "a", range(1, 5))
    assert newest(checkpoints) == 4
    assert sorted(p.name for p in (tmp_path / "a").iterdir()) == ["000003", "000004"]
    # A process killed while it wrote leaves this; the next save takes it away.
    (tmp_path / "a" / "000005.orbax-checkpoint-tmp" / "state").mkdir(parents=True)
    assert newest(Checkpoints(tmp_path / "a")) == 4
    Checkpoints(tmp_path / "a", 1).save(tree(7), {"number": 7})
    assert [p.name for p in (tmp_path / "a").iterdir()] == ["000005"]
    checkpoints.clear()
    assert not (tmp_path / "a").exists()
    assert capfd.readouterr() == ("", "")


def truncate(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def flip(path):
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def largest(folder):
    """The file that the arrays are in."""
    return max((p for p in folder.rglob("*") if p.is_file()), key=lambda p: p.stat().st_size)


@pytest.mark.parametrize("harm", [truncate, flip, lambda path: path.unlink()])
@pytest.mark.parametrize("file", [largest, lambda folder: folder / "manifest.ocdbt"])
def test_a_damaged_checkpoint_is_passed_over_with_a_warning(tmp_path, capfd, harm, file):
    checkpoints = written(tmp_path / "a", (1, 2))
    harm(file(tmp_path / "a" / "000002"))
    assert newest(checkpoints) == 1
    out, err = capfd.readouterr()
    assert out == ""
    assert "000002 is damaged; using the one before it" in err
    assert len(err.splitlines()) == 1
    checkpoints.save(tree(3), {"number": 3})
    assert newest(checkpoints) == 3
    harm(file(tmp_path / "a" / "000003"))
    with pytest.raises(JaxpendError, match=r"no checkpoint in .* is whole; choose another name"):
        newest(checkpoints)


def test_a_checkpoint_without_its_manifest_was_not_finished(tmp_path, capfd):
    checkpoints = written(tmp_path / "a", (1, 2))
    (tmp_path / "a" / "000002" / MANIFEST).unlink()
    assert newest(checkpoints) == 1
    assert "000002 was not finished; using the one before it" in capfd.readouterr().err
    (tmp_path / "a" / "000001" / MANIFEST).unlink()
    assert checkpoints.newest(lambda _: None) is None


def test_a_full_disk_is_one_sentence_and_leaves_what_there_was(tmp_path, capfd):
    checkpoints = written(tmp_path / "a", (1, 2))
    big = tree(3) | {"noise": list(jax.random.normal(jax.random.key(0), (9, 100_000)))}
    with limited_file_size(50_000), pytest.raises(JaxpendError) as error:
        checkpoints.save(big, {"number": 3})
    text = str(error.value)
    assert text == f"cannot write a checkpoint to {tmp_path / 'a'}: File too large"
    assert sorted(p.name for p in (tmp_path / "a").iterdir()) == ["000001", "000002"]
    assert newest(checkpoints) == 2
    assert capfd.readouterr() == ("", "")
