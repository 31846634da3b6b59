"""`bag video`: as many frames as steps, that differ, in both formats, the same bytes each time."""

import importlib.util
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.bags.test_foreign import run
from tests.recordings import made
from tests.support.worlds import tiny
from uav_dc_ros.experiments import video

Capture = pytest.CaptureFixture[str]
WORLD = tiny()
STEPS = 2


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bag of a short mission, whose second step has no users."""
    recorded = made.flight(WORLD, steps=STEPS)
    lost = made.changing("users", 0, 1, lambda _: None)
    kept = [message for message in recorded if lost(message) is not None]
    return made.write(tmp_path_factory.mktemp("flown") / "B", kept, made.about(WORLD))


def test_a_gif_has_a_frame_for_each_step(flown: Path, tmp_path: Path, capsys: Capture) -> None:
    options = ("--out", tmp_path / "v.gif", "--fps", 4, "--width", 161)
    assert f"mission 0 of {flown}, 3 frames, 0.8 s" in run(capsys, "video", flown, *options)
    with Image.open(tmp_path / "v.gif") as gif:
        assert (gif.n_frames, gif.size[0]) == (STEPS + 1, 160)
        frames, durations_ms = [], []
        for n in range(gif.n_frames):
            gif.seek(n)
            frames.append(np.asarray(gif.convert("RGB"), dtype=np.int64))
            durations_ms.append(gif.info["duration"])
    assert durations_ms == [250, 250, 3000]
    changed = [np.abs(one - other).max(-1) > 60 for one, other in pairwise(frames)]
    assert all(0.001 < one.mean() < 0.2 for one in changed), "the UAV moves, the page stays"


@pytest.mark.long
@pytest.mark.skipif(
    importlib.util.find_spec("imageio_ffmpeg") is None, reason="the extra video is not installed"
)
def test_an_mp4_has_them_too_and_the_same_bytes_each_time(
    flown: Path, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    import imageio_ffmpeg

    monkeypatch.setattr(video, "FRAMES_MAX", 2)  # every second step, and the last one
    for name in ("a", "b"):
        run(capsys, "video", flown, "--out", tmp_path / f"{name}.mp4", "--fps", 2, "--width", 160)
    assert (tmp_path / "a.mp4").read_bytes() == (tmp_path / "b.mp4").read_bytes()
    frames = imageio_ffmpeg.read_frames(str(tmp_path / "a.mp4"))
    about = next(frames)
    assert (about["codec"], about["size"][0], about["fps"]) == ("h264", 160, 2.0)
    assert len(list(frames)) == 2 + 2 * video.LAST_S


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--out", "{new}.avi"], "expected a file NAME.gif or NAME.mp4"),
        (["--out", "{bag}.gif"], "bag.gif exists; expected a new name"),
        (["--out", "{new}.gif", "--mission", "7"], "nothing of mission 7 can be drawn; expected its users"),
        (["--out", "{new}.gif", "--fps", "0"], "'0'; expected a number from 0.5 to 50"),
    ],
)
def test_videos_that_are_not_drawn(
    flown: Path, tmp_path: Path, capsys: Capture, options: list[str], expected: str
) -> None:
    (tmp_path / "bag.gif").write_bytes(b"mine")
    given = [option.format(new=tmp_path / "new", bag=tmp_path / "bag") for option in options]
    assert expected in run(capsys, "video", flown, *given, status=2)
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [("bag.gif", b"mine")]


def test_without_the_encoder_the_error_names_the_extra(
    flown: Path, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "imageio_ffmpeg", None)
    error = run(capsys, "video", flown, "--out", tmp_path / "v.mp4", status=2)
    assert 'imageio-ffmpeg is not installed; expected it from: pip install "uav_dc_ros[video]"' in error
    assert not list(tmp_path.iterdir())
