# SPDX-License-Identifier: Apache-2.0
"""Every command of README and docs runs as it is typed, page by page, in a folder that has what the pages speak of.

``my.bag``, ``d435.bag`` ... are the first second of bags/demo, on the topics that the commands name; where a topic is
called rectified, its images are. ``truth.tum`` is the demo's truth, ``V1_01_easy`` a data set of its images, and
``left_*.png``, ``left/`` and the like are pictures of a board. The tutorial runs with the whole demo, in
``test_docs.py``.

:data:`NOT_RUN` holds what does not run here, and the reason.
"""

from __future__ import annotations

import re
import shlex
import shutil
from glob import glob
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from calibration_folder import write_calibrations
from slam_bags.reading.readings import DepthReading, StereoReading
from slam_bags.reading.sensor_bag import SensorBag
from slam_bags.reading.sensor_topics import is_rectified
from slam_bags.storage.bag import BagReader, BagWriter
from slam_bags.storage.sensor_writer import LEFT_FRAME, RIGHT_FRAME, TOF_FRAME, SensorWriter
from slam_bringup.cli import slam
from slam_bringup.pipeline.configuration import SystemConfig
from slam_bringup.pipeline.sensor_pipeline import depth_stage, stereo_stage
from slam_bringup.processes.launch_plan import ARGUMENTS
from slam_core.geometry import make_transform
from slam_core.messages import rectified_info
from slam_core.trajectory import write_tum

ROOT = Path(__file__).resolve().parent.parent
DEMO = ROOT / "bags/demo"
PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "bags/README.md", *(ROOT / "docs").rglob("*.md")])
FRAMES = 6

NOT_RUN = {
    r"(\./)?slam (demo|test|setup)": "makes the environment that runs this test; test_extras.py asks what demo starts",
    r"\./slam nodes": "starts processes; test/integration/test_executables.py runs it",
    r"\./slam view": "serves a page until Ctrl-C; test/slam_viewer/page looks at it",
    r"\./slam live ": "needs a camera",
    r"\./slam run .*--scheduler ": "needs a cluster; test_run_many.py maps bags on workers",
    r"\./slam run monday.bag ": "test_run_many.py maps several bags on as many workers as there are processors",
    r"\./slam (simulate tagged_corridor|run out/corridor) ": "test/integration/test_fiducials.py runs both as typed",
    r"slam (simulate|run|calibrate refine) untriggered": "test_untriggered_pair.py runs each, with smaller pictures",
    r"\./slam (simulate back_to_back|run out/turn|doctor out/turn)": "test_several_cameras.py does, with less pixels",
    r"\./slam merge ": "takes finished maps; test/slam_bringup/commands/test_merge.py makes some and merges them",
    r"(\S*/)?dask ": "serves a cluster until Ctrl-C; test/sjsam_node/regions/test_tasks.py starts one",
    r"\./slam post ": "runs until Ctrl-C; test/slam_bringup/commands/test_live.py looks at what it starts",
    r"docker ": "needs a Docker daemon",
    r"source |rosdep |colcon |python3? -m (venv|colcon)|(\.venv/bin/)?pip |ros2 bag ": "needs ROS or the network",
    r"evo_ape ": "a program of evo, which test/slam_core/test_evaluation.py compares with ours",
    r"ros2 launch (realsense2_camera|depthai_ros_driver|zed_wrapper)|ros2 param ": "needs a vendor's driver and camera",
    r"ros2 launch slam_bringup": "starts nodes; arguments are checked below, test/integration/test_launch.py runs it",
    r"ros2 topic pub ": "needs nodes at work; test_radio_link_views.py publishes the same on both topics",
    r"ros2 run": "starts a node; test/integration/test_executables.py runs each",
    r"export |eval ": "sets up a shell; test/slam_bringup/test_cli.py asks for completions",
}
"""What a command begins with, and why it is not run here."""


def left_out(line: str) -> bool:
    return any(re.match(start, line) for start in NOT_RUN)


def commands(page: Path) -> list[str]:
    """Lines of the page's shell blocks, without comments."""
    blocks = re.findall(r"```bash\n(.*?)```", page.read_text(encoding="utf-8"), flags=re.S)
    lines = [re.split(r"\s+#", line)[0].strip() for block in blocks for line in block.splitlines()]
    return [line for line in lines if line]


TYPED = [(page, line) for page in PAGES if page.name != "tutorial.md" for line in commands(page)]


@pytest.mark.slow
@pytest.mark.parametrize("page", sorted({page for page, _ in TYPED}), ids=lambda page: page.name)
def test_the_commands_of_a_page_run_as_typed(page, tmp_path, monkeypatch, request):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "docs").symlink_to(ROOT / "docs")  # configuration.yaml
    with SensorBag(DEMO) as demo:
        write_tum(tmp_path / "truth.tum", demo.ground_truth(""))
    for line in lines_of(page):
        prepare(line, request)
        words = [name for word in shlex.split(line)[1:] for name in (sorted(glob(word)) or [word])]
        done = CliRunner().invoke(slam, words)
        assert done.exit_code == 0, f"{line}: {done.output}{done.exception}"


def test_what_is_not_run_is_typed_somewhere_and_names_arguments_that_there_are():
    for start in NOT_RUN:
        assert any(re.match(start, line) for _, line in TYPED), f"no page has {start}"
    known = {argument.name for argument in ARGUMENTS} | {"rviz"}
    for _, line in TYPED:
        if line.startswith("ros2 launch slam_bringup"):
            assert {word.partition(":=")[0] for word in line.split()[4:]} <= known, line
        if match := re.match(r"ros2 run (?!nav2_)(\w+) (\w+)", line):
            assert f"{match[2]} = {match[1]}." in (ROOT / "src" / match[1] / "setup.py").read_text(), line


def test_benchmarks_have_the_options_that_pages_give_them():
    given = [c for page in PAGES for c in re.findall(r"python (benchmarks/[^`\n]+)", page.read_text(encoding="utf-8"))]
    assert len(given) > 20
    for command in given:
        script, *rest = command.split()
        text = (ROOT / script).read_text(encoding="utf-8")
        for option in re.findall(r"--[a-z][a-z0-9-]*", " ".join(rest)):
            assert f'"{option}"' in text, f"{command}: no {option}"


def lines_of(page: Path) -> list[str]:
    """What is run of a page: of the lines of an earlier page only those whose map the next lines need."""
    earlier = {line for p, line in TYPED if PAGES.index(p) < PAGES.index(page) and "run my.bag" not in line}
    return [line for p, line in TYPED if p == page and line not in earlier and not left_out(line)]


def prepare(line: str, request: pytest.FixtureRequest) -> None:
    """What a command reads and no command before it has made."""
    words = shlex.split(line)
    if "anchor" in words and not Path("out/demo").exists():
        write_bag(Path("demo.bag"), {})
        assert CliRunner().invoke(slam, ["run", "demo.bag", "-o", "out/demo"]).exit_code == 0
    topics = dict(words[i + 1].split("=") for i, word in enumerate(words) if word == "--topic")
    for path in (Path(word) for word in words if re.fullmatch(r"\w+\.bag", word)):
        write_bag(path, topics)
    if "V1_01_easy" in words:
        write_euroc(Path("V1_01_easy"))
    if "calibrate" in words and words[3].endswith("/"):
        for source, folder in zip(("left", "right"), words[3:5], strict=True):
            Path(folder).mkdir()
            for jpg in request.getfixturevalue("data_dir").glob(f"calib_opencv_left_right/{source}0[1-8].jpg"):
                shutil.copy(jpg, folder)
    if "run" in words and "--calibration" in words:
        shutil.rmtree("calibration")  # the board's pictures are not those of the demo's cameras
        write_calibrations(DEMO, Path("calibration"))
    if "left_*.png" in words:
        for jpg in sorted(request.getfixturevalue("data_dir").glob("calib_opencv_left_right/*0[1-8].jpg")):
            assert cv2.imwrite(jpg.stem.replace("0", "_0") + ".png", cv2.imread(str(jpg)))


def write_bag(path: Path, topics: dict[str, str]) -> None:
    """The first second of the demo as it is, or on the topics by role; masks beside it that leave nothing out."""
    mask, topics = topics.get("mask"), {role: topic for role, topic in topics.items() if role != "mask"}
    with SensorBag(DEMO) as demo, BagReader(DEMO) as raw, BagWriter(path) as bag:
        types = {topic: info.type_name for topic, info in raw.topics.items()}
        for topic, stamp, data in raw.raw():
            if stamp <= raw.start_ns + 10**9 and (not topics or topic == "/tf_static"):
                bag.write_raw(topic, types[topic], data, stamp)
        for reading in islice(demo.readings(), 3 * FRAMES) if mask else ():
            if isinstance(reading, StereoReading):
                SensorWriter(bag).picture(
                    mask.strip("/"), reading.stamp_ns, LEFT_FRAME, np.zeros_like(reading.pair.left)
                )
        if topics:
            write_renamed(SensorWriter(bag), demo, {role: topic.strip("/") for role, topic in topics.items()})


def write_renamed(writer: SensorWriter, demo: SensorBag, topics: dict[str, str]) -> None:
    """The demo's first images on the topics by role, rectified where the topic's name says so."""
    sensors = demo.sensors[""]
    stereo, depth = stereo_stage(sensors), depth_stage(SystemConfig(), sensors)
    for reading in islice(demo.readings(), 3 * FRAMES):
        stamp = reading.stamp_ns
        if isinstance(reading, StereoReading) and "left" in topics:
            stereo.add(reading.pair)
            images, infos = reading.pair, (sensors.left, sensors.right)
            if is_rectified(topics["left"]):
                (images,) = stereo.ready()
                infos = (
                    rectified_info(images.stereo.camera),
                    rectified_info(images.stereo.camera, images.stereo.baseline),
                )
            for side, frame, info in zip(("left", "right"), (LEFT_FRAME, RIGHT_FRAME), infos, strict=True):
                writer.picture(topics[side], stamp, frame, getattr(images, side))
                writer.info(f"{topics[side].rpartition('/')[0]}/camera_info", stamp, frame, info)
        elif isinstance(reading, DepthReading) and "depth" in topics:
            depth.add(reading.raw)
            (image,) = depth.ready()
            writer.picture(topics["depth"], stamp, TOF_FRAME, image.depth)
            writer.picture(topics["amplitude"], stamp, TOF_FRAME, image.amplitude)
            writer.info(
                f"{topics['depth'].rpartition('/')[0]}/camera_info", stamp, TOF_FRAME, rectified_info(image.camera)
            )


def write_euroc(root: Path) -> None:
    """The demo's first pairs in EuRoC's folders."""
    with SensorBag(DEMO) as demo:
        sensors = demo.sensors[""]
        pairs = [r.pair for r in demo.readings() if isinstance(r, StereoReading)][:FRAMES]
        T_base_left, baseline = sensors.transform("base", "left"), sensors.right.baseline
    stage = stereo_stage(sensors)
    for pair in pairs:
        stage.add(pair)
    for images in stage.ready():
        for number, image in enumerate((images.left, images.right)):
            data = root / "mav0" / f"cam{number}" / "data"
            data.mkdir(parents=True, exist_ok=True)
            assert cv2.imwrite(str(data / f"{images.stamp_ns}.png"), image)
            with (data.parent / "data.csv").open("a") as index:
                index.write(f"{images.stamp_ns},{images.stamp_ns}.png\n")
    c = images.stereo.camera
    for number in (0, 1):
        T = T_base_left @ make_transform(np.eye(3), np.array([number * baseline, 0.0, 0.0]))
        (root / "mav0" / f"cam{number}" / "sensor.yaml").write_text(
            f"T_BS:\n  cols: 4\n  rows: 4\n  data: {T.ravel().tolist()}\n"
            f"resolution: [{c.width}, {c.height}]\nintrinsics: [{c.fx}, {c.fy}, {c.cx}, {c.cy}]\n"
            "distortion_coefficients: [0.0, 0.0, 0.0, 0.0]\n"
        )
