"""Several nodes in one process."""

import pytest
from bench import Bench, pose_at
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import Image

from us_sim.errors import SettingsError
from us_sim.nodes.composed import Composed
from us_sim.run.plan import NodeProcess

NODES = ["probe_tracker", "tissue_deformer", "slice_interpolator"]


def test_nodes_in_one_process_make_images_and_report_each(small_scene):
    given = {"scene": str(small_scene)}
    parts = tuple(NodeProcess(node, given) for node in NODES)
    process = NodeProcess("composed", {"nodes": NODES}, parts=parts)
    bench = Bench(process.arguments())
    try:
        images = bench.collect(Image, "ultrasound/image")
        reports = bench.collect(DiagnosticArray, "diagnostics")
        composed = bench.make(Composed)
        poses = bench.publisher(PoseStamped, "tracker/pose")
        for second in range(1, 500):
            poses.publish(pose_at(0.001, second))
            bench.spin_for(5)
            names = {each.name for report in reports for each in report.status}
            if len(images) > 5 and names >= {f"/{node}" for node in (*NODES, "composed")}:
                break
        assert len(images) > 5
        assert composed.realtime_priority
        pids = {v.value for r in reports for s in r.status for v in s.values if v.key == "pid"}
        assert len(pids) == 1
    finally:
        bench.close()
    assert not any(thread.is_alive() for thread in composed._threads)


def test_a_node_that_cannot_be_composed_is_named(bench):
    with pytest.raises(SettingsError, match=r"composed\.nodes: 'probe_trucker'.*probe_tracker"):
        bench.make(Composed, nodes=["probe_trucker"])
