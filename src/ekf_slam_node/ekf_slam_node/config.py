# SPDX-License-Identifier: Apache-2.0
"""Every parameter of the EKF: names, defaults, units and ranges (the node declares its ROS parameters from here)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_core.config import Config, group, parameter
from slam_core.estimation.calibration_error import CalibrationErrorConfig
from slam_core.estimation.chi_square import chi_square_bound
from slam_core.geometry import FloatArray
from slam_core.imu_config import ImuConfig

_GATE_PROBABILITY = 0.999
"""Share of true pairs inside the chi-square gate of one feature."""
MAX_FRAME_FEATURES = 800
"""The strongest features of a frame that are looked at."""
MAX_UPDATE_LANDMARKS = 120
"""Most landmarks of one update: further ones tell it little and cost the square of their number."""
STANDING_FRAMES = 5
"""Frames without motion after which the rig counts as standing: nothing is mapped until it moves."""


@dataclass(frozen=True)
class MotionConfig(Config):
    """Constant-velocity model: the rig's accelerations are its noise (Eq. 5.6)."""

    sigma_acceleration: float = parameter(3.0, "noise of the linear acceleration", unit="m/s2", minimum=1e-6)
    sigma_angular_acceleration: float = parameter(4.0, "noise of the angular acceleration", unit="rad/s2", minimum=1e-6)
    sigma_initial_velocity: float = parameter(
        2.0, "uncertainty of the speed of a rig never seen before", unit="m/s", minimum=0.0
    )
    sigma_initial_turn_rate: float = parameter(2.0, "the same for its turn rate", unit="rad/s", minimum=0.0)

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations (6,) of the accelerations, m/s2 and rad/s2."""
        return np.repeat([self.sigma_acceleration, self.sigma_angular_acceleration], 3)

    @property
    def initial_variance(self) -> FloatArray:
        """Variances (6,) of the velocities of a rig never seen before."""
        return np.repeat([self.sigma_initial_velocity, self.sigma_initial_turn_rate], 3) ** 2


@dataclass(frozen=True)
class InertialConfig(ImuConfig):
    """An IMU: whether it is used, its clock and its noise."""

    use: str = parameter(
        "auto",
        "whether an IMU is used: where there is one, never, or always (a run without one is refused)",
        choices=("auto", "off", "on"),
    )
    time_offset: float = parameter(
        0.0,
        "added to the IMU's stamps, so that they mean the same time as the images'",
        unit="s",
        minimum=-1.0,
        maximum=1.0,
    )
    sigma_time_offset: float = parameter(
        0.001,
        "by how much time_offset may be wrong as long as the images show no more; 0: it is exact, nothing is learnt",
        unit="s",
        minimum=0.0,
        maximum=0.05,
    )


@dataclass(frozen=True)
class ExternalOdometryConfig(Config):
    """Odometry of wheels, legs or another estimator: how well it is known before anything is learnt of it."""

    use: str = parameter("auto", "whether it is used: where there is one, or never", choices=("auto", "off"))
    sigma_scale: float = parameter(
        0.03, "error of its way's scale (the wheels' radius), which is learnt", minimum=1e-6, maximum=0.5
    )
    sigma_turn_scale: float = parameter(
        0.05, "error of its turns' scale (the wheels' distance), which is learnt", minimum=1e-6, maximum=0.5
    )
    sigma_yaw_deg: float = parameter(
        2.0, "error of its mounting's yaw, which is learnt", unit="deg", minimum=1e-6, maximum=45.0
    )


@dataclass(frozen=True)
class RideConfig(Config):
    """Lift rides, and the barometer that measures their height beside the accelerometer."""

    use: str = parameter(
        "auto",
        "whether rides are looked for: by IMU and barometer where both agree, by the IMU alone, or never",
        choices=("auto", "imu", "off"),
    )
    sigma_pressure_height: float = parameter(
        0.3, "noise of a barometer whose readings claim no variance, as a height", unit="m", minimum=1e-3
    )
    sigma_pressure_scale: float = parameter(
        0.03, "error of heights by air pressure for want of the temperature (0.035 for 10 degrees)", minimum=1e-6
    )
    pressure_drift: float = parameter(
        0.02, "random walk of a barometer's height: weather, doors, ventilation", unit="m/sqrt(s)", minimum=0.0
    )


@dataclass(frozen=True)
class MeasurementConfig(Config):
    """The time that a picture takes to be read out, while the features come about."""

    readout: float = parameter(
        0.0, "time from a picture's first row to its last, where known beforehand; negative from the last to the first",
        unit="s", minimum=-0.1, maximum=0.1,
    )  # fmt: skip
    sigma_readout: float = parameter(
        0.0, "standard deviation of that time; 0: nothing is known, it is learnt alone", unit="s", minimum=0.0,
        maximum=0.1,
    )  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.readout != 0.0 and self.sigma_readout == 0.0:
            raise ValueError("parameter 'readout' is given without 'sigma_readout': say how well it is known")


@dataclass(frozen=True)
class FeatureAssociationConfig(Config):
    """Data association of features and landmarks (thesis chapter 4)."""

    method: str = parameter(
        "mahalanobis", "how a feature chooses among its candidates", choices=("nearest", "mahalanobis", "jcbb", "ccda")
    )
    descriptor_threshold: float = parameter(0.75, "least cosine of the descriptors", minimum=-1.0, maximum=1.0)
    descriptor_weight: float = parameter(
        40.0,
        "weight of 1 - cosine beside the normalised distance of Eq. 4.8; 0 is Algorithm 2 as published",
        minimum=0.0,
    )
    nearest_associate: float = parameter(
        0.15, "nearest: distance within which a feature is a landmark's, g_A of Algorithm 1", unit="m", minimum=1e-6
    )
    nearest_new: float = parameter(
        0.2,
        "nearest: distance from all landmarks beyond which a feature may become a new one, g_R of Algorithm 1",
        unit="m",
        minimum=1e-6,
    )
    min_inliers: int = parameter(8, "associations below which the rig is lost", minimum=3)
    seed: int = parameter(0, "seed of the random samples", minimum=0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.nearest_new < self.nearest_associate:
            raise ValueError(
                f"parameter 'nearest_new' ({self.nearest_new} m) is below 'nearest_associate'"
                f" ({self.nearest_associate} m): what is near enough for a landmark would become another"
            )

    @property
    def gate(self) -> float:
        """Gate on the squared Mahalanobis distance of one feature, three coordinates."""
        return chi_square_bound(_GATE_PROBABILITY, 3)


@dataclass(frozen=True)
class LandmarkConfig(Config):
    """Map management: new landmarks, and those that are removed (section 4.4)."""

    target_in_view: int = parameter(80, "new landmarks are added until so many are observed", minimum=6)
    most_measured: int = parameter(
        60,
        "landmarks that a frame of followed features measures at most, those of which it tells most",
        minimum=6,
    )
    """The others stay landmarks, which closures need; the update has fewer rows (MH_01: 0.91 of a frame's time)."""
    min_sightings: int = parameter(3, "s_min of section 4.4", minimum=1)
    probation_frames: int = parameter(6, "N of section 4.4: frames a landmark has to reach min_sightings", minimum=1)
    min_hit_ratio: float = 0.15
    """A landmark seen in a smaller share of the frames in which it should be seen is removed."""
    min_expected: int = 12
    """Frames in which it should be seen before that share is judged."""


@dataclass(frozen=True)
class SubmapConfig(Config):
    """End of a submap and start of the next one (section 7.1)."""

    start: str = parameter(
        "independent",
        "what the next submap takes over: nothing but the last frame's own measurement, or Eq. 7.1",
        choices=("independent", "conditional"),
    )
    max_distance: float = parameter(1.0, "a submap ends this far from its start", unit="m", minimum=0.05)
    max_landmarks: int = parameter(400, "a submap ends at this number of landmarks", minimum=10)
    max_frames: int = parameter(300, "a submap ends after this number of frames", minimum=2)
    drift: bool = parameter(False, "poses of a submap are as uncertain as the filter drifts; for one filter alone")
    compact: bool = parameter(
        False, "send submaps rounded, in half the bytes: 32-bit factor of the covariance, 8-bit descriptors"
    )


@dataclass(frozen=True)
class EkfSlamConfig(Config):
    """Everything the EKF node can be told."""

    agent: str = parameter("", "name of this rig, prefix of its submap frames")
    error: str = parameter(
        "invariant",
        "error state: landmarks' errors rotate with the rig's, or stand alone",
        choices=("invariant", "standard"),
    )
    motion: MotionConfig = group(MotionConfig)
    imu: InertialConfig = group(InertialConfig)
    odometry: ExternalOdometryConfig = group(ExternalOdometryConfig)
    ride: RideConfig = group(RideConfig)
    measurement: MeasurementConfig = group(MeasurementConfig)
    association: FeatureAssociationConfig = group(FeatureAssociationConfig)
    landmark: LandmarkConfig = group(LandmarkConfig)
    submap: SubmapConfig = group(SubmapConfig)
    calibration: CalibrationErrorConfig = group(CalibrationErrorConfig)
