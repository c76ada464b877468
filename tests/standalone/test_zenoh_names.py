"""Keys, tokens, gids and attachments, against those that rmw_zenoh and xxHash have."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from us_sim.standalone.interfaces import _service_fields, _typestore, type_hash
from us_sim.standalone.middleware import EndpointQos
from us_sim.standalone.zenoh_names import (
    Entity,
    attachment,
    key_of,
    qos_text,
    read_attachment,
    read_qos,
    read_token,
)

STRING_HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
ADD_HASH = "RIHS01_e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a"

# The examples of rmw_zenoh's design.md.
TALKER = (
    "@ros2_lv/2/8b20917502ee955ac4476e0266340d5c/0/10/MP/%/%/talker/%chatter/"
    f"std_msgs::msg::dds_::String_/{STRING_HASH}/::,7:,:,:,,"
)
TOKENS = [
    "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/0/NN/%/%/listener",
    TALKER,
    "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/10/MS/%/%/listener/%chatter/"
    f"std_msgs::msg::dds_::String_/{STRING_HASH}/::,10:,:,:,,",
    "@ros2_lv/2/f9980ee0495eaafb3e38f0d19e2eae12/0/10/SS/%/%/add_two_ints_server/%add_two_ints/"
    f"example_interfaces::srv::dds_::AddTwoInts_/{ADD_HASH}/::,10:,:,:,,",
    "@ros2_lv/2/e1dc8d1b45ae8717fce78689cc655685/0/10/SC/%/%/add_two_ints_client/%add_two_ints/"
    f"example_interfaces::srv::dds_::AddTwoInts_/{ADD_HASH}/::,10:,:,:,,",
]


@pytest.mark.parametrize("token", TOKENS)
def test_the_documented_tokens_are_read_and_written(token):
    entity = read_token(token)
    assert entity is not None
    assert entity.token == token
    assert (entity.domain, entity.namespace, entity.enclave) == (2, "/", "/")


def test_a_token_tells_of_a_publisher():
    talker = read_token(TALKER)
    assert (talker.node, talker.name, talker.node_number, talker.number) == (
        "talker",
        "/chatter",
        0,
        10,
    )
    assert talker.qos == EndpointQos(depth=7)
    assert talker.key == f"2/chatter/std_msgs::msg::dds_::String_/{STRING_HASH}"


def test_each_field_of_a_token_is_where_rmw_zenoh_writes_it():
    """By the order of `KeyexprIndex` and of `qos_to_keyexpr` in its liveliness_utils.cpp."""
    quality = EndpointQos(2, 1, 2, 5, 1_000_000_002, 3_000_000_004, 3, 5_000_000_006)
    ours = ("MS", "/us_sim/skin", "/left", "skin", "/left/chatter", "std_msgs::msg::dds_::String_")
    assert Entity(0, "aa", 3, 4, *ours, STRING_HASH, quality).token == (
        "@ros2_lv/0/aa/3/4/MS/%us_sim%skin/%left/skin/%left%chatter/std_msgs::msg::dds_::String_/"
        "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18/"
        "2:1:2,5:1,2:3,4:3,5,6"
    )


def test_backends_that_lyrical_adds_to_a_token_change_nothing():
    """rmw_zenoh_cpp 0.10.5 tells after the quality of service where a type's bytes may be."""
    assert read_token(f"{TALKER}/cpu/cuda:0") == read_token(TALKER)


@pytest.mark.parametrize(
    "token",
    [
        "@ros2_lv/2/aa/0/0/NN/%/%",
        "@ros2_lv/2/aa/0/0/XX/%/%/listener",
        "@ros2_lv/two/aa/0/0/NN/%/%/listener",
        "@other/2/aa/0/0/NN/%/%/listener",
        "@ros2_lv/2/aa/0/0/NN/%//listener",
        TALKER.rpartition("/")[0],
        TALKER.replace("::,7:", "::"),
        TALKER.replace(",7:", ",seven:"),
    ],
)
def test_what_is_no_token_of_rmw_zenoh_is_none(token):
    assert read_token(token) is None


def test_the_documented_keys_are_made():
    assert key_of(2, "/add_two_ints", "example_interfaces::srv::dds_::AddTwoInts_", ADD_HASH) == (
        f"2/add_two_ints/example_interfaces::srv::dds_::AddTwoInts_/{ADD_HASH}"
    )
    assert type_hash("std_msgs/msg/String") == STRING_HASH


def test_services_have_the_hashes_of_rosidl(monkeypatch):
    """That of Trigger, and the documented one of a service that is not among ours."""
    assert type_hash("std_srvs/srv/Trigger") == (
        "RIHS01_eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f"
    )
    store, name = _typestore(), "example_interfaces/srv/AddTwoInts"
    number = store.fielddefs["std_msgs/msg/Int64"][1][0][1]
    monkeypatch.setitem(store.fielddefs, f"{name}_Request", ([], [("a", number), ("b", number)]))
    monkeypatch.setitem(store.fielddefs, f"{name}_Response", ([], [("sum", number)]))
    for each, fields in _service_fields(name).items():
        monkeypatch.setitem(store.fielddefs, each, fields)
    assert store.hash_rihs01(name) == ADD_HASH


def test_a_gid_is_the_xxh3_of_the_token_with_its_lowest_byte_first():
    assert read_token(TALKER).gid.hex() == "ac170f31eadcd9ff0cd86d7a17907d1c"


def test_an_attachment_has_the_layout_of_zenohs_serialization():
    gid = bytes(range(16))
    data = attachment(3, 0x0102030405060708, gid)
    assert data.hex() == f"03{'00' * 7}0807060504030201" + "10" + gid.hex()
    assert read_attachment(data) == (3, 0x0102030405060708, gid)
    assert read_attachment(data[:-1]) is None
    assert read_attachment(data.replace(b"\x10\x00", b"\x0f\x00", 1)) is None


durations = st.one_of(st.just(0), st.integers(1, 2**63 - 2))


@given(
    st.builds(
        EndpointQos,
        reliability=st.sampled_from([1, 2]),
        durability=st.sampled_from([1, 2]),
        history=st.sampled_from([1, 2]),
        depth=st.integers(1, 2000),
        deadline=durations,
        lifespan=durations,
        liveliness=st.sampled_from([1, 3]),
        liveliness_lease_duration=durations,
    )
)
def test_every_quality_of_service_survives_its_text(qos):
    assert read_qos(qos_text(qos)) == qos


def test_only_what_differs_from_the_default_is_written():
    assert qos_text(EndpointQos(depth=42)) == "::,:,:,:,,"
    latched = EndpointQos(depth=1, durability=EndpointQos.TRANSIENT_LOCAL, lifespan=10 * 10**9)
    assert qos_text(latched) == ":1:,1:,:10,0:,,"
    all_kept = EndpointQos(history=EndpointQos.KEEP_ALL, reliability=2, liveliness=3)
    assert qos_text(all_kept) == "2::2,10:,:,:3,,"
