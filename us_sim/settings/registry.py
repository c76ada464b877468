"""Choices of solvers, slicers, probes and more, by the names that users write.

One line an option: its name and where its class is. A class is imported when it is chosen, not
before. Packages of others add solvers and trackers under the entry point groups named here.
"""

from us_sim.errors import (
    CalibrationError,
    ProbeError,
    ScoreError,
    SolverError,
    TrackingError,
    VolumeError,
)
from us_sim.settings.choice import Choice, Option

SOLVERS = Choice(
    "tissue solver",
    key="solver",
    group="us_sim.solvers",
    error=SolverError,
    described=True,
    fem="us_sim.tissue.solvers.fem:Fem",
    fem_nonlinear="us_sim.tissue.solvers.fem_nonlinear:FemNonlinear",
    fem_cg="us_sim.tissue.solvers.fem_cg:FemCg",
    msds="us_sim.tissue.solvers.msds:Msds",
)

SLICERS = Choice(
    "slicing method",
    key="method",
    scan_conversion="us_sim.slicing.cutting.scan_conversion:ScanConversion",
    per_pixel="us_sim.slicing.cutting.per_pixel:PerPixel",
)

_PHANTOMS = "us_sim.volume.phantom.phantom"
PHANTOMS = Choice(
    "phantom",
    key="phantom",
    error=VolumeError,
    upper_arm=f"{_PHANTOMS}:make_upper_arm",
    thrombosed_arm=f"{_PHANTOMS}:thrombosed_arm",
    drawn_arm=f"{_PHANTOMS}:draw_arm",
)

PROBES = Choice(
    "probe",
    key="geometry",
    error=ProbeError,
    needs=True,
    linear="us_sim.slicing.probe.probe:LinearProbe",
    convex="us_sim.slicing.probe.probe:ConvexProbe",
    sector="us_sim.slicing.probe.probe:SectorProbe",
)

COLLIDERS = Choice(
    "collider",
    key="shape",
    error=ProbeError,
    needs=True,
    sphere="us_sim.geometry.collider:Sphere",
    capsule="us_sim.geometry.collider:Capsule",
    rounded_box="us_sim.geometry.collider:RoundedBox",
    convex="us_sim.geometry.collider:Convex",
)

FILTERS = Choice(
    "filter",
    key="method",
    error=TrackingError,
    none="us_sim.tracking.filters:Unfiltered",
    one_euro=Option("us_sim.tracking.filters:OneEuro", "us_sim.tracking.settings:OneEuroSettings"),
    kalman=Option(
        "us_sim.tracking.filters:ConstantVelocityKalman", "us_sim.tracking.settings:KalmanSettings"
    ),
)

_NOTHING = "us_sim.settings.setting:Settings"
_INPUTS = "us_sim.nodes.tracker_inputs"
TRACKERS = Choice(
    "tracker source",
    key="source",
    group="us_sim.trackers",
    error=TrackingError,
    pose=Option(f"{_INPUTS}.topic_inputs:PoseInput", _NOTHING),
    pose_array=Option(f"{_INPUTS}.topic_inputs:PoseArrayInput", _NOTHING),
    tf=Option(f"{_INPUTS}.topic_inputs:TfInput", _NOTHING),
    camera=Option(f"{_INPUTS}.camera_input:CameraInput", "us_sim.tracking.settings:CameraSettings"),
    six_dof_mouse=Option(
        f"{_INPUTS}.topic_inputs:SixDofMouseInput", "us_sim.tracking.settings:SixDofMouseSettings"
    ),
    haptic=Option(f"{_INPUTS}.topic_inputs:HapticInput", "us_sim.tracking.settings:HapticSettings"),
    openigtlink=Option(
        f"{_INPUTS}.openigtlink_input:OpenIGTLinkInput",
        "us_sim.tracking.settings:OpenIGTLinkSettings",
    ),
    path=Option(f"{_INPUTS}.topic_inputs:PoseInput", _NOTHING),
)

_EXERCISES = "us_sim.scoring.exercise"
EXERCISES = Choice(
    "task of an exercise",
    key="kind",
    error=ScoreError,
    needs=True,
    compression="us_sim.scoring.compression:Compression",
    keep_force=f"{_EXERCISES}:KeepForce",
    centre=f"{_EXERCISES}:Centre",
)

_EVALUATION = "us_sim.evaluation"
EVALUATIONS = Choice(
    "evaluation",
    key="subject",
    tissue=Option(f"{_EVALUATION}.tissue.report:TISSUE", _NOTHING),
    stability=Option(f"{_EVALUATION}.stability.report:STABILITY", _NOTHING),
    slice=Option(f"{_EVALUATION}.slice.report:SLICE", _NOTHING),
    hand=Option(f"{_EVALUATION}.hand.report:HAND", f"{_EVALUATION}.settings:HandSettings"),
    tracking=Option(f"{_EVALUATION}.tracking.report:TRACKING", _NOTHING),
    image=Option(f"{_EVALUATION}.image.report:IMAGE", _NOTHING),
    latency=Option(f"{_EVALUATION}.latency.report:LATENCY", _NOTHING),
    viewer=Option(f"{_EVALUATION}.viewer.report:VIEWER", _NOTHING),
    measured=Option(
        f"{_EVALUATION}.measured.report:MEASURED", f"{_EVALUATION}.settings:MeasuredData"
    ),
)

_CALIBRATION = "us_sim.command.calibration"
CALIBRATIONS = Choice(
    "calibration",
    key="what",
    error=CalibrationError,
    camera=Option(
        f"{_CALIBRATION}:calibrate_photos", f"{_CALIBRATION}_settings:CameraCalibrationSettings"
    ),
    pivot=Option(
        f"{_CALIBRATION}:calibrate_tip", f"{_CALIBRATION}_settings:PivotCalibrationSettings"
    ),
    landmarks=Option(
        f"{_CALIBRATION}:calibrate_registration",
        f"{_CALIBRATION}_settings:LandmarkCalibrationSettings",
    ),
    time=Option(
        f"{_CALIBRATION}:calibrate_clock", f"{_CALIBRATION}_settings:ClockCalibrationSettings"
    ),
)
