# SPDX-License-Identifier: Apache-2.0
"""SURF on an OpenCL device against the compiled kernels, and what happens where the device fails.

pocl, which runs OpenCL on the CPU, stands for a GPU here.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from slam_core.config import from_mapping
from stereo_frontend.detection.features import FeatureConfig, FeatureExtractor
from stereo_frontend.frontend import Frontend
from stereo_frontend.frontend_config import FrontendConfig
from stereo_frontend.surf import surf_detector
from stereo_frontend.surf.surf import SurfConfig, SurfDetector, describe, pair_descriptors
from stereo_frontend.surf.surf_device import SurfDevice, best_opencl_device

cl = pytest.importorskip("pyopencl", reason="pyopencl is not installed (requirements-dev.txt)")
from stereo_frontend.surf import opencl_surf  # noqa: E402
from stereo_frontend.surf.opencl_surf import OpenClSurf  # noqa: E402


@pytest.fixture(scope="module")
def device():
    devices = opencl_surf.known_devices()
    if not devices:
        pytest.skip("there is no OpenCL device (requirements-dev.txt has pocl-binary-distribution)")
    return devices[0]


@pytest.fixture(scope="module")
def on_device(device) -> Callable[[bool], OpenClSurf]:
    """SURF on the device in double or in single precision."""
    if not device.double_fp_config:
        pytest.skip(f"{device.name} has no double precision")
    made = {double: OpenClSurf(device, double=double) for double in (True, False)}
    return made.__getitem__


def noise(height: int = 130, width: int = 170, blur: float = 1.5, seed: int = 3) -> np.ndarray:
    values = np.random.default_rng(seed).uniform(0, 255, (height, width)).astype(np.float32)
    return cv2.normalize(cv2.GaussianBlur(values, (0, 0), blur), None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def keep_all(uv, size, response):
    return np.arange(len(uv))


def found_on_cpu(image: np.ndarray, doubled: bool, threshold: float, room: int = 20000) -> tuple[np.ndarray, int]:
    """Keypoints of the compiled kernels, and the number of octaves."""
    height, width = np.array(image.shape) * (2 if doubled else 1)
    octaves = surf_detector.fitting_octaves(int(height), int(width), 3)
    found = np.empty((room, 4), np.float32)
    number = surf_detector.find_keypoints(image, doubled, octaves, np.float32(threshold), found)
    return found[:number], octaves


SHAPES = [(130, 170), (97, 201), (240, 75), (40, 36), (33, 90)]
"""The smallest have filters that fit in fewer octaves; sides are odd and no multiples of a group of work items."""


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("doubled", [True, False])
def test_keypoints_are_the_cpus_to_the_last_bit_and_in_its_order(on_device, shape, doubled):
    image = noise(*shape)
    expected, octaves = found_on_cpu(image, doubled, 2.0)
    assert len(expected) > 0 or octaves == 0
    found = on_device(True).find(image, doubled=doubled, octaves=octaves, threshold=2.0)
    np.testing.assert_array_equal(found, expected)


def test_in_single_precision_they_are_the_cpus_but_for_one_in_a_hundred(on_device):
    image = noise(240, 320)
    expected, octaves = found_on_cpu(image, True, 2.0)
    found = on_device(False).find(image, doubled=True, octaves=octaves, threshold=2.0)
    assert len(expected) > 1000
    distance, nearest = cKDTree(found[:, :3]).query(expected[:, :3])
    same = distance < 1e-3
    assert same.sum() > 0.99 * max(len(expected), len(found))
    np.testing.assert_array_equal(found[nearest[same], 3], expected[same, 3])


@pytest.mark.parametrize("double", [True, False])
@pytest.mark.parametrize("kind", ["pair", "upright", "oriented"])
def test_descriptors_are_the_cpus(on_device, double, kind):
    """Also of keypoints at the edges of the image, of any scale."""
    image, rng = noise(), np.random.default_rng(5)
    places = np.column_stack([rng.uniform(-0.4, 169.4, 300), rng.uniform(-0.4, 129.4, 300), rng.uniform(0.9, 12, 300)])
    places = places.astype(np.float32).astype(np.float64)
    if kind == "pair":
        expected, got = pair_descriptors(image, places), on_device(double).describe_for_pair(image, places)
    else:
        expected = describe(image, places, upright=kind == "upright", extended=True)
        got = on_device(double).describe(image, places, upright=kind == "upright")
    assert np.linalg.norm(expected, axis=1).max() == pytest.approx(1.0, abs=1e-5)
    same = np.abs(got - expected).max(axis=1) < 1e-3
    # One whose orientation is a tie, or in single precision a wavelet's sign, may differ.
    assert same.mean() >= (1.0 if double else 0.98)


def test_single_precision_keeps_its_digits_in_large_squares_of_bright_pictures(on_device):
    """Sums over the image, or over bright pixels as they are, would lose two of them."""
    image, rng = (noise(500, 600, blur=5.0).astype(float) / 16 + 200).astype(np.uint8), np.random.default_rng(6)
    places = np.column_stack([rng.uniform(90, 509, 200), rng.uniform(90, 409, 200), rng.uniform(6, 13, 200)])
    places = places.astype(np.float32).astype(np.float64)
    expected = describe(image, places, upright=False, extended=True)
    error = np.abs(on_device(False).describe(image, places, upright=False) - expected).max(axis=1)
    assert np.median(error) < 5e-7


@pytest.mark.parametrize("shape", [(5, 7), (1, 1), (100, 120)])
def test_flat_and_tiny_images_have_no_keypoints(on_device, shape):
    surf, image = on_device(True), np.full(shape, 255, np.uint8)
    octaves = found_on_cpu(image, True, 0.5)[1]
    assert surf.find(image, doubled=True, octaves=octaves, threshold=0.5).shape == (0, 4)
    assert surf.describe(image, np.zeros((0, 3)), upright=False).shape == (0, 128)


def test_more_keypoints_than_there_is_room_for_are_found_again(device, monkeypatch):
    image = noise()
    expected, octaves = found_on_cpu(image, True, 2.0)
    surf = OpenClSurf(device)
    surf._room = 7
    np.testing.assert_array_equal(surf.find(image, doubled=True, octaves=octaves, threshold=2.0), expected)
    monkeypatch.setattr(opencl_surf, "MOST_KEYPOINTS", 9)
    few = surf.find(image, doubled=True, octaves=octaves, threshold=2.0)
    np.testing.assert_array_equal(few, found_on_cpu(image, True, 2.0, room=9)[0])


def test_the_same_picture_gives_the_same_bytes_from_two_threads_too(on_device):
    images = [noise(seed=seed) for seed in range(2)]
    detector = SurfDetector(device=opened(on_device(True)))
    alone = [detector(image, 0.1, keep_all) for image in images]
    with ThreadPoolExecutor(2) as pool:
        together = list(pool.map(lambda image: detector(image, 0.1, keep_all), images * 4))
    for k, keypoints in enumerate(together):
        np.testing.assert_array_equal(keypoints.uv, alone[k % 2].uv)
        np.testing.assert_array_equal(keypoints.descriptors, alone[k % 2].descriptors)


def opened(surf: object) -> SurfDevice:
    device = SurfDevice()
    device._surf, device.name, device._errors = surf, "stand-in", opencl_surf.DEVICE_ERRORS
    return device


@pytest.mark.parametrize("upright", [True, False])
@pytest.mark.parametrize("extended", [True, False])
@pytest.mark.parametrize("for_pairs", [True, False])
def test_a_detector_gives_the_cpus_features(on_device, upright, extended, for_pairs):
    image, config = noise(), SurfConfig(upright=upright, extended=extended)
    expected = SurfDetector(config, for_pairs=for_pairs)(image, 0.1, keep_all)
    keypoints = SurfDetector(config, for_pairs=for_pairs, device=opened(on_device(True)))(image, 0.1, keep_all)
    assert keypoints.descriptors.shape[1] == (128 if extended or for_pairs else 64)
    np.testing.assert_array_equal(keypoints.uv, expected.uv)
    np.testing.assert_array_equal(keypoints.size, expected.size)
    np.testing.assert_allclose(keypoints.descriptors, expected.descriptors, atol=1e-3)


@pytest.mark.data
def test_on_real_pictures_keypoints_are_the_same_and_descriptors_but_for_one_in_a_thousand(on_device, data_dir):
    pictures = sorted((data_dir / "euroc_v101_visnav100" / "euroc_V1").glob("*_0.jpg"))[::50]
    pictures += sorted((data_dir / "kitti_stereo_51x2" / "KITTI_sequence_1" / "image_l").glob("*.png"))[::25]
    detector, twin = SurfDetector(device=opened(on_device(True))), SurfDetector()
    different = total = 0
    for path in pictures:
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        keypoints, expected = (d(image, 0.3, keep_all) for d in (detector, twin))
        np.testing.assert_array_equal(keypoints.uv, expected.uv)
        different += int((np.abs(keypoints.descriptors - expected.descriptors).max(axis=1) > 1e-3).sum())
        total += len(expected)
    assert total > 5000
    assert different <= 0.001 * total


# -- choice of the device, and its failures ----------------------------------------------------------------------------


def fake(name: str, kind: int, platform: str = "Vendor") -> SimpleNamespace:
    return SimpleNamespace(name=name, type=kind, platform=SimpleNamespace(name=platform))


def platforms_of(*devices: SimpleNamespace) -> Callable[[], list[SimpleNamespace]]:
    return lambda: [SimpleNamespace(get_devices=lambda: list(devices))]


def test_a_gpu_is_chosen_before_the_cpus_devices_and_any_device_by_its_name(monkeypatch):
    cpu, gpu = fake("pthread", cl.device_type.CPU, "Portable Computing Language"), fake("RTX", cl.device_type.GPU)
    monkeypatch.setattr(cl, "get_platforms", platforms_of(cpu))
    assert best_opencl_device() == ("pthread", False)
    monkeypatch.setattr(cl, "get_platforms", platforms_of(cpu, gpu))
    assert best_opencl_device() == ("RTX", True)
    assert opencl_surf.find_device() is gpu
    assert opencl_surf.find_device("rtx") is gpu
    assert opencl_surf.find_device("portable") is cpu
    with pytest.raises(LookupError, match="'Radeon'; known: RTX, pthread"):
        opencl_surf.find_device("Radeon")


def no_platform() -> list[object]:
    raise cl.LogicError("clGetPlatformIDs", "PLATFORM_NOT_FOUND_KHR", -1001)


@pytest.mark.parametrize("platforms", [no_platform, list, platforms_of(fake("pthread", cl.device_type.CPU))])
@pytest.mark.parametrize(("wanted", "complains"), [("auto", False), ("gpu", True), ("cpu", False), ("Radeon", True)])
def test_without_a_gpu_surf_is_on_the_cpu_and_says_so_where_one_was_asked_for(
    monkeypatch, platforms, wanted, complains
):
    monkeypatch.setattr(cl, "get_platforms", platforms)
    device = SurfDevice(wanted)
    assert device.name == "cpu"
    assert bool(device.diagnostic) == complains
    assert device.compute(lambda surf: "device", lambda: "cpu") == "cpu"


@pytest.mark.parametrize(("wanted", "diagnostic"), [("auto", ""), ("gpu", "pip install pyopencl"), ("cpu", "")])
def test_without_pyopencl_surf_is_on_the_cpu(monkeypatch, wanted, diagnostic):
    monkeypatch.setitem(sys.modules, "stereo_frontend.surf.opencl_surf", None)
    monkeypatch.delattr("stereo_frontend.surf.opencl_surf")
    device = SurfDevice(wanted)
    assert best_opencl_device() is None
    assert device.name == "cpu"
    assert diagnostic in device.diagnostic
    assert bool(device.diagnostic) == bool(diagnostic)


def test_a_device_that_cannot_compile_the_kernels_is_not_used(device, monkeypatch):
    monkeypatch.setattr(opencl_surf, "_MACROS", opencl_surf._MACROS | {"SAMPLES": "nonsense"})
    chosen = SurfDevice(device.name)
    assert chosen.name == "cpu"
    assert "\n" not in chosen.diagnostic
    assert device.name.strip() in chosen.diagnostic


ERRORS = [
    cl.MemoryError("clCreateBuffer", "MEM_OBJECT_ALLOCATION_FAILURE", -4),
    cl.RuntimeError("clEnqueueNDRangeKernel", "OUT_OF_RESOURCES", -5),
    cl.LogicError("clEnqueueNDRangeKernel", "INVALID_COMMAND_QUEUE", -36),
    MemoryError("host"),
]


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
@pytest.mark.parametrize("after", [0, 1, 7, 20])
def test_a_device_that_fails_leaves_the_same_frames_to_the_cpu_and_one_complaint(
    device, monkeypatch, stereo_pair, error, after
):
    """Fails at its first transfer or kernel, at one in the middle of a frame, in a later frame."""
    frontend = Frontend(FrontendConfig(features=FeatureConfig(device=device.name, tracking="never")))
    calls = iter(range(10**6))
    run = OpenClSurf._run

    def failing(self, *arguments: object) -> None:
        if next(calls) >= after:
            raise error
        run(self, *arguments)

    monkeypatch.setattr(OpenClSurf, "_run", failing)
    pair, twin = stereo_pair(), Frontend(FrontendConfig(features=FeatureConfig(tracking="never")))
    for _ in range(2):
        features, expected = frontend.process(pair), twin.process(pair)
        np.testing.assert_array_equal(features.uv, expected.uv)
        np.testing.assert_allclose(features.descriptors, expected.descriptors, atol=1e-3)
    assert next(calls) <= after + 2, "it was tried again, not only for the other image of the pair"
    report = frontend.report()
    assert report.device == "cpu"
    assert report.advice == (report.device_diagnostic,)
    assert device.name.strip() in report.device_diagnostic


def test_other_errors_are_not_swallowed(on_device):
    with pytest.raises(TypeError):
        opened(on_device(True)).compute(lambda surf: surf.find(None), lambda: "cpu")


@pytest.mark.parametrize("mode", ["stereo", "tof"])
def test_the_front_end_uses_the_device_that_its_parameter_names(device, stereo_pair, mode):
    config = from_mapping(FrontendConfig, {"mode": mode, "features": {"device": device.name.lower()}})
    frontend, twin = Frontend(config), Frontend(FrontendConfig(mode=mode))
    assert frontend.report().device == device.name.strip()
    if mode == "stereo":
        features, expected = frontend.process(stereo_pair()), twin.process(stereo_pair())
        np.testing.assert_array_equal(features.uv, expected.uv)
        np.testing.assert_allclose(features.xyz, expected.xyz, atol=1e-4)
    assert frontend.report().advice == ()


@pytest.mark.parametrize("detector", ["orb", "censure"])
def test_other_detectors_open_no_device(monkeypatch, detector):
    monkeypatch.setattr(cl, "get_platforms", no_platform)
    frontend = Frontend(FrontendConfig(features=FeatureConfig(detector=detector, device="gpu")))
    assert frontend.report().advice == ()


def test_an_extractor_alone_opens_the_device(device):
    image = noise()
    found, expected = (FeatureExtractor(FeatureConfig(device=name))(image) for name in (device.name, "cpu"))
    np.testing.assert_array_equal(found.uv, expected.uv)
    np.testing.assert_allclose(found.descriptors, expected.descriptors, atol=1e-3)
