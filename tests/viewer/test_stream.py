"""How fast a page of a real browser takes what streams."""

from typing import Any

from awaiting import until

from us_sim.viewer.stream import Feed, Packet, Simulator

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
    page: Any, simulator: Simulator
) -> None:
    slow, quick = Feed("slow", rate=None), Feed("quick", rate=None)
    simulator.add(slow, quick)
    page.goto(page.address)
    page.evaluate(TAKE)
    until(lambda: slow.is_watched and quick.is_watched, "the page watches")

    def offer(feed: Feed) -> int:
        feed.offer(lambda sequence: Packet(feed.kind, sequence, {}, b""))
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
