"""The adapters of the examples, with doubles of PsychoPy and of a camera's driver.

The one for PyTorch is in the tests of the training.
"""

import re
import runpy
import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from tests.source_tree import ROOT

ADAPTERS = ROOT / "examples" / "adapters"
SIDE_PX = 48


@pytest.fixture
def color(rng):
    return rng.integers(0, 256, (SIDE_PX, SIDE_PX, 3), dtype=np.uint8)


@pytest.fixture(autouse=True)
def adapters(monkeypatch):
    monkeypatch.syspath_prepend(str(ADAPTERS))


class ImageStim:
    def __init__(self, win, image, **kwargs):
        self.win, self.image, self.kwargs = win, image, kwargs

    def setImage(self, image, log):
        self.image = image


@pytest.fixture
def seen_stim(monkeypatch):
    package, visual = ModuleType("psychopy"), ModuleType("psychopy.visual")
    visual.ImageStim = ImageStim
    monkeypatch.setitem(sys.modules, "psychopy", package)
    monkeypatch.setitem(sys.modules, "psychopy.visual", visual)
    monkeypatch.delitem(sys.modules, "psychopy_ocufilter", raising=False)
    from psychopy_ocufilter import SeenImageStim

    return SeenImageStim


def test_a_stimulus_shows_what_the_eye_sees(seen_stim, color, tmp_path):
    stimulus = seen_stim(
        "window", color, "myopia", 10.0, distance=2.0, pupilDiameter=3.0, size=(1, 1)
    )
    assert (stimulus.win, stimulus.kwargs) == ("window", {"size": (1, 1)})
    shown = [stimulus.image]
    stimulus.setEye(pupilDiameter=5.0, focus=1.0)
    shown.append(stimulus.image)
    for image in shown:
        assert image.min() >= -1.0
        assert image.max() <= 1.0
    blurs = [np.abs(np.diff(image, axis=1)).mean() for image in shown]
    assert blurs[1] < blurs[0], "a wider pupil blurs more"
    # PsychoPy draws the first row at the bottom.
    light = color.astype(float) / 127.5 - 1.0
    upright = np.corrcoef(np.flipud(shown[0]).ravel(), light.ravel())[0, 1]
    assert upright > np.abs(np.corrcoef(shown[0].ravel(), light.ravel())[0, 1])
    Image.fromarray(color).save(tmp_path / "a.png")
    np.save(tmp_path / "a.npy", np.full(color.shape[:2], 2.0, np.float32))
    again = seen_stim(
        *("window", tmp_path / "a.png", "myopia", 10.0),
        depth=tmp_path / "a.npy",
        pupilDiameter=3.0,
    )
    np.testing.assert_array_equal(again.image, shown[0])
    with pytest.raises(ValueError, match="distance and depth"):
        seen_stim("window", color, "myopia", 10.0)


@pytest.mark.clients
def test_the_lines_of_the_page_show_a_stimulus(seen_stim, color, monkeypatch, tmp_path):
    page = (ROOT / "docs" / "how-to" / "choose.md").read_text(encoding="utf-8")
    (lines,) = re.findall(r"```py\n(from psychopy .*?)```", page, re.DOTALL)
    calls = []
    visual = sys.modules["psychopy.visual"]
    sys.modules["psychopy"].visual = visual
    visual.SeenImageStim = seen_stim
    visual.Window = lambda: SimpleNamespace(flip=lambda: calls.append("flip"))
    monkeypatch.setattr(
        ImageStim, "draw", lambda self: calls.append(self.image), raising=False
    )
    monkeypatch.chdir(tmp_path)
    Image.fromarray(color).save("photo.jpg")
    exec(lines, {})
    image, flip = calls
    assert image.shape == color.shape
    assert flip == "flip"


def test_the_filter_is_imported_with_the_first_stimulus():
    source = (ADAPTERS / "psychopy_ocufilter.py").read_text(encoding="utf-8")
    head = source.partition("class ")[0]
    assert "filter_service" not in head.partition('"""\n\n')[2]


@pytest.fixture
def video(tmp_path, color):
    import av

    path = tmp_path / "walk.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=20)
        stream.width = stream.height = SIDE_PX
        stream.pix_fmt = "bgr0"
        frame = av.VideoFrame.from_ndarray(color, format="rgb24")
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def camera_program(monkeypatch, camera, *arguments):
    driver = SimpleNamespace(Camera=camera)
    monkeypatch.setitem(sys.modules, "pyvirtualcam", driver)
    monkeypatch.setattr(sys, "argv", ["virtual_camera.py", *map(str, arguments)])
    runpy.run_path(str(ADAPTERS / "virtual_camera.py"), run_name="__main__")


@pytest.mark.clients
def test_a_virtual_camera_is_sent_what_the_eye_sees(monkeypatch, video, color):
    sent = []

    class Device:
        device = "/dev/video9"

        def __init__(self, width, height, fps):
            assert (width, height, fps) == (SIDE_PX, SIDE_PX, 20.0)

        def __enter__(self):
            return self

        def __exit__(self, *_):
            pass

        def send(self, frame):
            sent.append(frame.copy())

        def sleep_until_next_frame(self):
            pass

    camera_program(monkeypatch, Device, video, "--fov-deg", 10, "--frames", 3)
    assert len(sent) == 3  # the one frame of the video, again and again
    assert sent[0].shape == color.shape
    assert sent[0].dtype == np.uint8
    assert sent[0].std() < 0.9 * color.std(), "it is blurred"
    np.testing.assert_array_equal(sent[1], sent[0])


def test_without_a_device_the_camera_says_so_in_one_line(monkeypatch, video):
    def camera(width, height, fps):
        raise RuntimeError("no backend\nfound")

    with pytest.raises(SystemExit, match="virtual_camera: no backend found"):
        camera_program(monkeypatch, camera, video)
