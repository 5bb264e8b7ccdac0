# SPDX-License-Identifier: Apache-2.0
"""Names that were parameters once and are constants of the code now, so that an old file gets a clear answer."""

from __future__ import annotations

FIXED = {
    "MaskConfig": "maximum_incidence_deg noise_multiple minimum_neighbours",
    "FrontendConfig": "max_relative_sigma right_surplus",
    "FeatureConfig": "grid_columns grid_rows surplus adaptation",
    "SurfConfig": "octaves threshold",
    "MatchingConfig": "max_size_ratio neighbours",
    "DisparityConfig": (
        "inner_radius max_shift min_correlation max_disagreement row_sigma slope_sigma sigma_scale sigma_floor"
    ),
    "PixelNoiseConfig": "row_floor row_slope memory min_matches min_factor max_factor",
    "SelfCalibrationConfig": (
        "min_chi_square min_row_error min_moments min_parallax memory row_floor row_reach min_similarity max_ratio"
    ),
    "FusionConfig": "motion_speed motion_rate mapping_sigma lookup",
    "TofFeatureConfig": "clip gamma lookup",
    "OdometryConfig": (
        "keyframe_overlap keyframe_angle_deg max_correction max_correction_deg max_gap search_after restart_after"
    ),
    "GyroConfig": "max_gap",
    "RegistrationConfig": (
        "coarse_points min_points max_iterations tolerance start_level image_size min_overlap max_conflict "
        "rim_share ambiguity"
    ),
    "IcpConfig": "relative_max_distance final_spacings shrinkage trimmed iterations tolerance neighbours",
    "GridConfig": (
        "relative_voxel_size block_points min_points eigenvalue_floor surface_levels slack flatness agreement "
        "surface_smoothing rim_ratio rim_min_points rim_blur rim_smoothing smoothing"
    ),
    "SearchConfig": (
        "max_rotation_deg rotation_step_deg rotations max_translation translation_step tolerance "
        "lattice_points shortlist starts judge_points judge_tolerance score_gain candidates"
    ),
    "UncertaintyConfig": "probe least_loss loss_noise free_sigma sigma_floor",
    "MotionConfig": "coast_time aid_gate aid_stamp_tolerance",
    "MeasurementConfig": (
        "max_relative_depth_sigma min_sigma_px min_sigma_depth noise_memory noise_tolerance max_noise_factor"
    ),
    "FeatureAssociationConfig": (
        "nearest_associate joint_features min_inlier_ratio guess_min_inliers guess_ratio "
        "guess_descriptor_threshold hypotheses max_gate_px"
    ),
    "LandmarkConfig": "min_hit_ratio min_expected",
    "SubmapConfig": "min_frames min_shared lost_frames restart_sigma_velocity restart_sigma_turn_rate",
    "DenseConfig": "move_distance move_angle_deg moves_at_once",
    "KeyframeConfig": "max_pixels",
    "StereoDepthConfig": (
        "block_size uniqueness_percent max_left_right speckle_size edge_radius jump window image_noise "
        "sigma_scale sigma_floor max_sigma"
    ),
    "TsdfConfig": "truncation_voxels",
    "SurfaceConfig": "min_images sigma_floor correlation min_triangles",
    "FloorPlanConfig": "clear_below min_points min_rays ray_step storey_height max_cells",
    "GlobalMapConfig": "unlinked_sigma compared_at_once compared_at_settling joined_at_once redundant_matches",
    "SmootherConfig": "settled_work settled_ties",
    "EstimatorConfig": "relative_tolerance live_tolerance live_iterations",
    "RobustConfig": "probability",
    "RegionConfig": "open quiet relinearize",
    "ClosureConfig": (
        "near_candidates least_news alike_candidates informative_sigma ratio place_threshold "
        "ransac_distance min_near_inliers min_spread min_overlap confirmations probability"
    ),
    "AssociationConfig": "probability max_variance_factor joint_pairs position_noise",
    "PlaceRecognitionConfig": "branching depth training_descriptors proposals",
    "ConsistencyConfig": "outlier_probability outlier_share rounds settling_rounds view_change retry waiting",
}
"""Names by class of the configuration; a group that is gone stands for all its parameters."""


def is_fixed(config_type: type, name: str) -> bool:
    """True if ``name`` was a parameter or a group of a configuration, or of one that it extends."""
    return any(name in FIXED.get(base.__name__, "").split() for base in config_type.__mro__)
