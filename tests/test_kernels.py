"""Compiled kernels that are kept: whole ones are used, all others are compiled again."""

import importlib.util
import logging
import os
import pickle

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba.core import config

from us_sim import kernels

KERNEL = """
from us_sim.kernels import njit

@njit(cache=True)
def triple(x):
    return 3 * x
"""


@pytest.fixture
def kept(tmp_path, monkeypatch):
    """The folder where kernels are kept, empty, and nothing said yet."""
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path / "kept"))
    monkeypatch.setattr(kernels, "_said", set())
    return tmp_path / "kept"


@pytest.fixture
def kernel(tmp_path):
    """Makes the kernel anew, as another process would."""
    file = tmp_path / "triples.py"
    file.write_text(KERNEL)

    def make():
        spec = importlib.util.spec_from_file_location("triples", file)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module.triple

    return make


def the_file(kept):
    (file,) = kept.rglob("*.kernel")
    return file


def hits(kernel):
    return sum(kernel.stats.cache_hits.values())


def test_what_was_compiled_is_loaded(kept, kernel):
    assert kernel()(7) == 21
    again = kernel()
    assert (again(7), hits(again)) == (21, 1)
    assert the_file(kept).stat().st_mode & 0o777 == 0o600


@pytest.mark.parametrize(
    "damage",
    [
        lambda content: content[:-1],
        lambda content: content[:0],
        lambda content: content[:40] + bytes([content[40] ^ 1]) + content[41:],
        lambda content: bytes(len(content)),
    ],
)
def test_a_damaged_file_is_compiled_again_and_that_is_said_once(kept, kernel, damage, caplog):
    kernel()(7)
    file = the_file(kept)
    whole = file.read_bytes()
    file.write_bytes(damage(whole))
    again = kernel()
    with caplog.at_level(logging.WARNING):
        assert (again(7), again(7.0), hits(again)) == (21, 21.0, 0)
    (said,) = caplog.messages
    assert said == f"{file} is not used (its checksum is wrong), so its kernel is compiled again"
    third = kernel()
    assert (third(7), hits(third)) == (21, 1)


def test_a_file_that_others_may_have_written_is_never_unpickled(kept, kernel, tmp_path):
    class Planted:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "broken_in"),)

    kernel()(7)
    file = the_file(kept)
    content = pickle.dumps(Planted())
    file.write_bytes(kernels._checksum(file.name, content) + content)
    file.chmod(0o620)
    again = kernel()
    assert (again(7), hits(again)) == (21, 0)
    assert not (tmp_path / "broken_in").exists()
    file.write_bytes(kernels._checksum(file.name, content) + content)
    file.chmod(0o600)
    assert kernel()(7) == 21  # its owner's own pickle is loaded, and is no kernel
    assert (tmp_path / "broken_in").exists()


def test_the_file_of_another_kernel_is_not_used(kept, kernel):
    whole, broken = kernel(), kernel()
    whole(7)
    one = the_file(kept)
    whole(7.0)
    (other,) = set(kept.rglob("*.kernel")) - {one}
    other.write_bytes(one.read_bytes())
    assert (broken(7.0), hits(broken)) == (21.0, 0)


def test_where_nothing_can_be_kept_kernels_work_all_the_same(kept, kernel, caplog):
    kept.write_text("no folder")
    with caplog.at_level(logging.WARNING):
        assert kernel()(7) == 21
    assert "kernels are not kept" in caplog.text


def test_code_of_an_earlier_source_is_let_go(kept, kernel, tmp_path):
    kernel()(7)
    earlier = the_file(kept)
    (tmp_path / "triples.py").write_text(KERNEL.replace("3 * x", "11 * x"))
    assert kernel()(7) == 77
    assert the_file(kept) != earlier


@pytest.mark.slow
@settings(max_examples=200, deadline=None)
@given(st.data())
def test_no_change_of_a_file_goes_unnoticed(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("files")
    files = kernels._CheckedFiles(folder, "f", "source")
    files.save("key", ["anything", 1.5])
    assert files.load("key") == ["anything", 1.5]
    (file,) = folder.iterdir()
    content = bytearray(file.read_bytes())
    at = data.draw(st.integers(0, len(content) - 1))
    if data.draw(st.booleans()):
        content[at] ^= data.draw(st.integers(1, 255))
    else:
        del content[at:]
    file.write_bytes(content)
    assert files.load("key") is None
    assert not file.exists()


def test_every_kernel_of_the_package_is_kept_so():
    from pathlib import Path

    import us_sim

    root = Path(us_sim.__file__).parent
    for file in root.rglob("*.py"):
        if file.name != "kernels.py":
            lines = file.read_text(encoding="utf-8").splitlines()
            assert not [line for line in lines if line.startswith("from numba import njit")], file
            assert not [line for line in lines if line.startswith("import numba")], file
