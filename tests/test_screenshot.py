"""`view --screenshot`: a viewer without a window is started, waited for, asked for a picture, and ended."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import cv2
import numpy as np
import psutil
import pytest
from command_line import bench, error_of
from posed_scene import fails

from semstab.errors import ConfigError
from semstab.recording import screenshot

SLEEPS = [sys.executable, "-c", "import time; time.sleep(600)"]


class Client:
    """Answers when it has been asked twice, and paints when it has been asked twice."""

    def __init__(self, kind: type[Exception] = TimeoutError) -> None:
        self.asked, self.painted, self.kind = 0, 0, kind

    def get_state(self) -> SimpleNamespace:
        self.asked += 1
        if self.asked == 1:
            raise ConnectionError("transport error")
        return SimpleNamespace(recordings=["one"] if self.asked > 2 else [])

    def save_screenshot(self, path: str) -> None:
        self.painted += 1
        if self.painted == 1:
            raise self.kind("Deadline expired")
        image = np.zeros((850, 1500, 3), np.uint8)
        image[: screenshot.BAR] = 255
        image[screenshot.BAR :, :, 2] = 90  # red, as OpenCV has it
        assert cv2.imwrite(path, image)


@pytest.fixture
def viewer(monkeypatch, tmp_path):
    """A recording, and a viewer that does nothing but live."""
    (tmp_path / "recording.rrd").write_bytes(b"RRF2")
    monkeypatch.setattr(screenshot, "viewer_command", lambda: SLEEPS)
    monkeypatch.setattr(screenshot, "SETTLED_S", 0.0)
    return tmp_path


def answers(monkeypatch, client: Client) -> None:
    monkeypatch.setattr("rerun.experimental.ViewerClient.connect", lambda url: client)


def test_a_picture_is_what_the_viewer_paints_without_its_bar_of_menus(viewer, monkeypatch):
    answers(monkeypatch, Client())
    before = {child.pid for child in psutil.Process().children(recursive=True)}
    result = bench("view", viewer / "recording.rrd", "--screenshot", viewer / "view.png", cwd=viewer)
    assert result.stdout.strip() == str(viewer / "view.png")
    image = cv2.imread(str(viewer / "view.png"))
    assert image.shape == (850 - screenshot.BAR, 1500, 3)
    assert (image == [0, 0, 90]).all()
    assert {child.pid for child in psutil.Process().children(recursive=True)} <= before


def test_a_viewer_that_ends_at_once_is_told_what_it_needs(viewer, monkeypatch):
    monkeypatch.setattr(screenshot, "viewer_command", lambda: [sys.executable, "-c", "raise SystemExit(3)"])
    said = error_of("view", viewer / "recording.rrd", "--screenshot", viewer / "view.png", cwd=viewer)
    assert "ended before it could paint (exit code 3)" in said
    assert "apt-get install mesa-vulkan-drivers" in said
    assert not (viewer / "view.png").exists()


def test_a_viewer_that_ends_while_it_paints_or_never_paints_is_named(viewer, monkeypatch):
    answers(monkeypatch, Client(ConnectionError))
    fails(ConfigError, "ended while it painted", screenshot.screenshot, viewer / "recording.rrd", viewer / "view.png")
    monkeypatch.setattr(screenshot, "PATIENCE_S", 0.0)
    client = Client()
    fails(
        ConfigError, "painted nothing within 0 s", screenshot.paint, client, viewer / "recording.rrd", viewer / "a.png"
    )


@pytest.mark.parametrize("name", ["view.jpg", "view", "nowhere/view.png"])
def test_a_picture_that_cannot_be_is_refused_before_a_viewer_starts(viewer, monkeypatch, name):
    monkeypatch.setattr(screenshot, "viewer_command", lambda: pytest.fail("started"))
    said = error_of("view", viewer / "recording.rrd", "--screenshot", viewer / name, cwd=viewer)
    assert "--screenshot" in said
    assert "name a file .png in a folder that is there" in said
