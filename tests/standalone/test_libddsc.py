"""Which C library of Cyclone DDS is taken, and why another one is not."""

import ctypes.util
import re
from pathlib import Path

import pytest

from us_sim.standalone import libddsc
from us_sim.standalone.libddsc import DdsError, load

NEEDED = ("dds_create_domain", "dds_writecdr")


@pytest.fixture
def real() -> Path:
    try:
        return Path(load(NEEDED)._name)
    except DdsError as error:
        pytest.skip(str(error))


def test_the_file_that_a_person_names_is_taken(real, tmp_path):
    named = tmp_path / "mine.so"
    named.symlink_to(real)
    assert load(NEEDED, {"US_SIM_DDSC": str(named)})._name == str(named)


def test_the_home_of_cyclone_comes_before_the_package(real, tmp_path):
    (tmp_path / "lib").mkdir()
    installed = tmp_path / "lib" / "libddsc.so"
    installed.symlink_to(real)
    assert load(NEEDED, {"CYCLONEDDS_HOME": str(tmp_path)})._name == str(installed)


def test_a_library_of_ros_is_found_without_the_package(real, tmp_path, monkeypatch):
    monkeypatch.setattr(libddsc.importlib.util, "find_spec", lambda _: None)
    monkeypatch.setattr(libddsc, "_ROS", tmp_path)
    for release in ("jazzy", "kilted"):
        (tmp_path / release / "lib").mkdir(parents=True)
    (tmp_path / "kilted" / "lib" / "libddsc.so").write_text("broken")
    installed = tmp_path / "jazzy" / "lib" / "libddsc.so"
    installed.symlink_to(real)
    assert load(NEEDED, {})._name == str(installed)


@pytest.mark.parametrize(
    ("name", "sentence"),
    [("libddsc.so.0.9.1", "version 0.9, but 0.10 to 11"), ("libddsc.so.12.0.0", "version 12.0,")],
)
def test_a_library_of_an_unknown_version_is_refused(tmp_path, name, sentence):
    (tmp_path / name).write_text("never loaded")
    (tmp_path / "libddsc.so").symlink_to(tmp_path / name)
    with pytest.raises(DdsError, match=re.escape(sentence)):
        load(NEEDED, {"US_SIM_DDSC": str(tmp_path / "libddsc.so")})


def test_what_is_no_library_of_cyclone_is_refused(tmp_path):
    (tmp_path / "libddsc.so").write_text("text")
    with pytest.raises(DdsError, match=r"libddsc\.so cannot be loaded .*; set US_SIM_DDSC"):
        load(NEEDED, {"US_SIM_DDSC": str(tmp_path / "libddsc.so")})
    other = ctypes.util.find_library("c")
    with pytest.raises(DdsError, match="has no dds_create_domain"):
        load(NEEDED, {"US_SIM_DDSC": str(other)})


def test_where_there_is_none_one_sentence_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr(libddsc.importlib.util, "find_spec", lambda _: None)
    monkeypatch.setattr(libddsc.ctypes.util, "find_library", lambda _: None)
    monkeypatch.setattr(libddsc, "_ROS", tmp_path)
    with pytest.raises(DdsError, match=r"none on this machine; set US_SIM_DDSC .*pip install"):
        load(NEEDED, {})


def test_the_type_that_a_sample_points_to_is_the_type_of_the_writer(real, monkeypatch):  # noqa: ARG001
    from us_sim.standalone import ddsc
    from us_sim.standalone.middleware import EndpointQos
    from us_sim.standalone.transport import DiscoveryRange, Participant

    if not hasattr(ddsc.lib, "dds_get_entity_sertype"):
        pytest.skip("this library tells no writer's type, as those before 11")
    name = "std_msgs::msg::dds_::String_"
    told = ddsc.serialized_type
    with Participant(77, reach=DiscoveryRange("OFF")) as participant:
        writer = participant.create_writer("rt/typed", name, EndpointQos())
        wanted = told(writer._handle, participant.handle, name).value
        older = OlderLibrary(ddsc.lib)
        monkeypatch.setattr(ddsc, "lib", older)
        assert told(writer._handle, participant.handle, name).value == wanted


class OlderLibrary:
    """The library without the function that came with version 11."""

    def __init__(self, library):
        self._library = library

    def __getattr__(self, name):
        if name == "dds_get_entity_sertype":
            raise AttributeError(name)
        return getattr(self._library, name)
