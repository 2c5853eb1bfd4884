"""The editor of landmarks in a headless browser: real clicks, drags and buttons."""

import shutil
import time

import numpy as np
import pytest
import trimesh

from nsm.correspondence.landmark_list import LandmarkList
from nsm.surfaces.landmark_files import read_pairs

SIZE = {"width": 1200, "height": 700}
PATIENCE = 30  # seconds


@pytest.fixture
def edited(tmp_path):
    pytest.importorskip("viser", reason="needs nsm[view]")
    from nsm.results.view import EditedShape, LandmarkEditor, running

    ball = trimesh.creation.icosphere(subdivisions=2)
    vertices, faces = np.array(ball.vertices), np.array(ball.faces)
    shapes = [EditedShape(name, vertices, faces, np.arange(len(vertices))) for name in "ab"]
    with running("nsm landmarks", "127.0.0.1", 0) as (server, address):
        yield LandmarkEditor(shapes, LandmarkList(2), tmp_path / "pairs.json", server), address


@pytest.fixture
def page():
    playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright")
    browser = next(filter(None, map(shutil.which, ("chromium", "google-chrome"))), None)
    if browser is None:
        pytest.skip("needs chromium")
    flags = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    with playwright.sync_playwright() as started:
        running = started.chromium.launch(executable_path=browser, args=flags)
        yield running.new_page(viewport=SIZE)
        running.close()


def until(condition):
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, "nothing happened"
        time.sleep(0.1)


def pixel(editor, point):
    """Where the browser's camera shows a point of the scene."""
    (client,) = editor.server.get_clients().values()
    camera = client.camera
    back = np.array(camera.position) - np.array(camera.look_at)
    back = back / np.linalg.norm(back)
    right = np.cross(camera.up_direction, back)
    right = right / np.linalg.norm(right)
    x, y, z = np.stack([right, np.cross(back, right), back]) @ (point - np.array(camera.position))
    focal = 0.5 * SIZE["height"] / np.tan(0.5 * camera.fov)
    return 0.5 * SIZE["width"] - focal * x / z, 0.5 * SIZE["height"] + focal * y / z


def test_real_clicks(edited, page):
    editor, address = edited
    page.goto(address)
    until(lambda: len(editor.server.get_clients()) == 1)
    page.wait_for_timeout(4000)  # the shapes are drawn

    def point(side, direction):
        vertices = editor.shapes[side].vertices
        return int((vertices @ np.array(direction)).argmax())

    def click(side, vertex, expected):
        page.mouse.click(*pixel(editor, editor.placed[side][vertex]))
        until(lambda: [m.vertices for m in editor.landmarks.landmarks] == expected)

    first, second = point(0, [-0.5, 0.3, 1]), point(1, [0.3, -0.4, 1])
    click(0, first, [(first, None)])
    click(1, second, [(first, second)])
    third = point(0, [0.4, -0.5, 1])
    click(0, third, [(first, second), (third, None)])

    for button, count in (("delete", 1), ("undo", 2)):
        page.get_by_role("button", name=button, exact=True).click()
        until(lambda count=count: len(editor.landmarks.landmarks) == count)
    page.get_by_role("button", name="save", exact=True).click()
    until(editor.file.exists)
    assert read_pairs(editor.file) == ([first], [second])
