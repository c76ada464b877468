"""Feeds: watched or not, the newest wins, and each is packed once.

How fast a page of a real browser takes what streams.
"""

from typing import Any

from awaiting import until
from hypothesis import given
from hypothesis import strategies as st

from us_sim.viewer.stream import ONLY_WATCHES, Feed, Packet, PageSources, PageStream

JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**53), 2**53) | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=8,
)


@given(
    st.text(min_size=1),
    st.integers(0, 2**53),
    st.dictionaries(st.text().filter(lambda key: key not in ("kind", "sequence")), JSON),
    st.binary(max_size=50),
)
def test_a_packet_comes_back(kind: str, sequence: int, header: dict, payload: bytes) -> None:
    packet = Packet(kind, sequence, header, payload)
    assert Packet.from_bytes(packet.encoded) == packet
    assert (len(packet.encoded) - len(payload)) % 8 == 0


def packed(feed: Feed, payload: bytes, made: list[int] | None = None) -> None:
    def pack(sequence: int) -> Packet:
        if made is not None:
            made.append(sequence)
        return Packet(feed.kind, sequence, {}, payload)

    feed.offer_packet(pack)


def test_who_watches_first_and_leaves_last_is_told() -> None:
    told: list[bool] = []
    feed = Feed("image", told.append)
    one, two = (lambda: None), (lambda: None)
    feed.add_watcher(one)
    feed.add_watcher(two)
    feed.remove_watcher(one)
    assert told == [True]
    feed.remove_watcher(two)
    assert told == [True, False]
    assert not feed.is_watched


def test_only_what_is_taken_is_packed_and_that_once() -> None:
    feed, made = Feed("image"), []
    for _ in range(5):
        packed(feed, b"x", made)
    assert feed.get_newest() is feed.get_newest()
    assert made == [5]


def test_what_cannot_be_packed_is_none_and_not_tried_again() -> None:
    feed, tried = Feed("image"), []
    feed.offer_packet(lambda sequence: tried.append(sequence))
    assert feed.get_newest() is None
    assert feed.get_newest() is None
    assert tried == [1]


def stream_of(*feeds: Feed) -> tuple[PageStream, list[None]]:
    sources, woken = PageSources(), []
    sources.add_feeds(*feeds)
    return PageStream(sources, lambda: woken.append(None)), woken


def test_a_page_gets_the_newest_when_it_has_drawn_the_last() -> None:
    feed = Feed("image", rate=None)
    page, woken = stream_of(feed)
    page.obey_message('{"watch": ["image"]}')
    packed(feed, b"1")
    assert [Packet.from_bytes(data).payload for data in page.collect_due(0.0)[0]] == [b"1"]
    packed(feed, b"2")
    packed(feed, b"3")
    assert page.collect_due(1.0) == ([], None)  # it has not drawn yet
    before = len(woken)
    page.obey_message('{"next": "image"}')
    assert len(woken) == before + 1
    assert [Packet.from_bytes(data).payload for data in page.collect_due(2.0)[0]] == [b"3"]
    page.obey_message('{"next": "image"}')
    assert page.collect_due(3.0) == ([], None)  # it has that one


def test_no_more_than_the_rate_and_the_wait_is_told() -> None:
    feed = Feed("image", rate=10.0)
    page, _ = stream_of(feed)
    page.obey_message('{"watch": ["image"]}')
    packed(feed, b"1")
    assert len(page.collect_due(0.0)[0]) == 1
    page.obey_message('{"next": "image"}')
    packed(feed, b"2")
    packets, later = page.collect_due(0.06)
    assert packets == []
    assert later is not None
    assert abs(later - 0.04) < 1e-9
    assert len(page.collect_due(0.1)[0]) == 1


def test_what_a_page_may_not_say_is_one_sentence() -> None:
    page, _ = stream_of(Feed("image"))
    for text in ("", "[1]", "{", "7", '{"a": 1}', '{"watch": 3}', '{"next": []}', "[" * 60000):
        wrong = page.obey_message(text)
        assert wrong is not None
        assert "load the page again" in wrong
    assert page.obey_message('{"watch": ["unknown", 3, null]}') is None
    assert page.collect_due(0.0) == ([], None)


def test_a_page_that_only_watches_is_refused_every_command() -> None:
    sources, done = PageSources(feeds={"image": Feed("image")}), []
    sources.commands["take"] = lambda value, _: done.append(value)
    page = PageStream(sources, lambda: None, only_watches=True)
    assert page.obey_message('{"watch": ["image"], "take": "a"}') == ONLY_WATCHES
    assert sources.feeds["image"].is_watched
    assert done == []


def test_a_page_that_has_gone_watches_nothing() -> None:
    feed = Feed("image")
    page, _ = stream_of(feed)
    page.obey_message('{"watch": ["image"]}')
    assert feed.is_watched
    page.watch_kinds([])
    assert not feed.is_watched


TAKE = """async () => {
    const { stream } = await import('/us_sim/assets/stream.js');
    window.taken = { slow: [], quick: [] };
    window.ends = [];
    stream.on('slow', ({ sequence }) => {
        window.taken.slow.push(sequence);
        return new Promise((end) => window.ends.push(end));
    });
    stream.on('quick', ({ sequence }) => window.taken.quick.push(sequence));
    for (const kind of ['slow', 'quick']) stream.watch(kind);
}"""


def test_no_more_is_on_its_way_than_the_next_while_one_is_drawn(
    page: Any, sources: PageSources
) -> None:
    slow, quick = Feed("slow", rate=None), Feed("quick", rate=None)
    sources.add_feeds(slow, quick)
    page.goto(page.address)
    page.evaluate(TAKE)
    until(lambda: slow.is_watched and quick.is_watched, "the page watches")

    def offer(feed: Feed) -> int:
        feed.offer_packet(lambda sequence: Packet(feed.kind, sequence, {}, b""))
        return feed.sequence

    def await_taken(kind: str, number: int) -> None:
        page.wait_for_function(
            "([kind, number]) => window.taken[kind].includes(number)", arg=[kind, number]
        )

    for _ in range(2):
        await_taken("slow", offer(slow))
    for _ in range(3):
        offer(slow)
        await_taken("quick", offer(quick))  # which would have come after it
    assert page.evaluate("window.taken.slow") == [1, 2]
    page.evaluate("window.ends[0]()")
    await_taken("slow", 5)
    assert page.evaluate("window.taken.slow") == [1, 2, 5]
    assert page.evaluate("window.taken.quick") == [1, 2, 3]
