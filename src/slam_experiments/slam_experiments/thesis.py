# SPDX-License-Identifier: Apache-2.0
"""The thesis's claims that experiments are compared with: in short, the section, and the words of our copy of it.

The copy is a scan that has lost many digits 0 and signs: there ``digits_lost`` is set, and the short form is our
reading.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Claim:
    """A claim in short, the section it stands in, and its words, letter for letter as in our copy."""

    short: str
    section: str
    quote: str
    digits_lost: bool = False

    def __str__(self) -> str:
        return f"{self.short} ({self.section}{', digits lost' if self.digits_lost else ''})"


ABSENT = "not given"
"""Text for a quantity of which the thesis says nothing."""

SMOOTHS = Claim(
    "SAM estimates the full trajectory", "6.5", "an estimate of the full trajectory is updated in each sample"
)
EKF_GROWTH = Claim("EKF O(n^2)", "6.6", "EKF O(n 2 ) O(n 2 ) O(n 2 )")

HEADING_VARIANCE = Claim(
    "an unknown heading becomes known", "6.2", "as can be seen in the figure, this value is decreasing"
)  # fmt: skip

SPECIFIED = Claim("close to the specified values", "2.4", "All values are close to the specified values")
CAMCUBE = Claim(
    "no specifications; distortion not to be relied on", "2.4", "For CamCube there are no specifications available."
)
EXTRINSICS = Claim(
    "confirmed by measurements on the rig", "2.4", "Measurements on the rig confirms that the parameters are accurate."
)

SIFT_MS = Claim("about 300 ms", "3.2", "Feature extraction in one image took about 3 ms with SIFT", digits_lost=True)
SURF_MS = Claim("180 ms", "3.2", "18 ms with SURF", digits_lost=True)
GPU_SURF = Claim("about 85 frames a second", "3.2", "it yields about 85 frames per second (FPS)")
SURF_FASTER = Claim("SURF faster", "3.2", "SURF performs better than SIFT for a larger image")
AMPLITUDE = Claim("used with the range image only", "3.4", "The amplitude image will also be used")
RANGE = Claim("the best features", "3.3", "The range image gives the best features.")
INTENSITY = Claim("unstable", "3.4", "the features seems to be unstable")

MAHALANOBIS = Claim(
    "Mahalanobis is more robust after drift", "4.5",
    "the method using the Mahalanobis distance is more robust especially when it comes to detect loop closure after"
    " drift",
)  # fmt: skip

RIG_LANDMARKS = Claim("349, one filter", "9.1.1", "with 349 landmarks in 135 seconds")
RIG_TIME = Claim("135 s, one filter", "9.1.1", "with 349 landmarks in 135 seconds")
RIG_END = Claim(
    "15 mm, one filter", "9.1.1",
    "The final estimated position of the rig is only 1.5 centimetres away from the initial position.",
)  # fmt: skip
MODEL = Claim("a picture", "9.1.1", "Figure 9.6 shows the resulting 3D spatial map")
HAND_LANDMARKS = Claim("356, one filter", "9.1.2", "The map has 356 landmarks")
HAND_END = Claim(
    "15 mm, one filter", "9.1.2", "is once again only 1.5 centimetres away from the initial position"
)  # fmt: skip
FIREMAN_10HZ = Claim(
    "a good overview map", "9.3",
    "is it possible to get a good overview map of a room just by looking around from a corner during a few seconds",
)  # fmt: skip
FIREMAN_5HZ = Claim("a bit incorrect", "9.1.3", "both the map and the trajectory is a bit incorrect")
SWEEP = Claim(
    "around 90 degrees", "9.1.4", "the estimated angle difference from the first and last state is around 9 degrees",
    digits_lost=True,
)  # fmt: skip
CONFERENCE_LANDMARKS = Claim("351", "9.1.5", "seconds, resulting in 351 landmarks")
CONFERENCE_TIME = Claim(
    "162 s features and 111 s EKF", "9.1.5",
    "The feature extraction part takes 162 seconds in total while the EKF-part of the algorithm takes 111",
)  # fmt: skip
ONE_FILTER_LANDMARKS = Claim("818", "9.1.6", "resulting in 818 landmarks")
ONE_FILTER_HEADING = Claim(
    "sigma too small, the trajectory bends", "9.1.6", "the estimated heading standard deviation is too small"
)
ONE_FILTER_TIME = Claim(
    "10 min in all, without features", "9.1.6", "The computation takes 1 minutes (image processing not included).",
    digits_lost=True,
)  # fmt: skip

EIGHT_LANDMARKS = Claim("1275", "9.2.2", "The resulting map has 1275 landmarks and 34 states.")
EIGHT_SUBMAPS = Claim("34", "9.2.1", "Figure 9.19 shows the 34 submaps")
EIGHT_TIME = Claim("155 s without features", "9.2.3", "155 seconds, excluding the time used for feature extraction")
EIGHT_JOINING = Claim("21 s", "9.2.2", "SAM is merging the 34 submaps into the map in Figure 9.22 in 21 seconds.")
CLOSURES_COST = Claim("more at the end", "9.2.2", "More time is used at the end because of loop closure")
EIGHT_END = Claim(
    "6 cm", "9.2.2", "This last submap ends only 6 centimetres away from the start of the first submap."
)  # fmt: skip
ROOMS_TIME = Claim("495 s for the submaps, without features", "9.2.1", "It took 495 seconds to create these submaps")
ROOMS_LOOP = Claim(
    "never merged", "9.2.1", "SJSAM has not been able to merge the submaps into something reasonable"
)  # fmt: skip
ROOMS_HEIGHT = Claim("almost 2 m at the end", "9.2.1", "the drift in heigh is almost 2 meters at the end")
WORKSHOP_BEFORE = Claim("3 cm as printed", "9.2.4", "is approximately 3 centimetres", digits_lost=True)
WORKSHOP_END = Claim("2 cm as printed", "9.2.4", "The error is now only about 2 centimetres.", digits_lost=True)

NDT_GRID = Claim(
    "fails where the grid is smaller than the motion", "10.3",
    "NDT can not make a successful registration if the grid size is smaller than the movement",
)  # fmt: skip
ICP_TURNS = Claim(
    "fails every turn of 10 deg", "10.2.1", "ICP failed all registrations for the rotation", digits_lost=True
)
NDT_TIME = Claim("about 2 s", "10.4", "one registration can be performed in approximately 2 s")
ICP_PATH = Claim(
    "difficulties in turns; height to 0.1 m", "10.2.3",
    "lies in the interval.1 z meters. ICP had some major difficulties as soon as the camera started to turn.",
    digits_lost=True,
)  # fmt: skip
NDT_PATH = Claim(
    "decent; height from -0.05 to 0.15 m, twice ICP's", "10.3.4",
    "The height is now in the interval.5 z.15 which is twice that of ICP.", digits_lost=True,
)  # fmt: skip

CH11_ABSENT = "missing from our copy"
"""Results of chapter 11: our copy ends where they begin."""
FIREMEN = Claim("imagined", "1.3", "Imagine that a large building is on fire.")
