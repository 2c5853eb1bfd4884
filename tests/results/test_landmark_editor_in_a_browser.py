"""The editor of landmarks in a headless browser: real clicks, drags and buttons."""

import time

import numpy as np
import pytest
import trimesh
from chromium import headless

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
def window():
    with headless(**SIZE) as opened:
        yield opened


def until(condition):
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, "nothing happened"
        time.sleep(0.1)


def pixel(editor, window, point):
    """Where the browser's camera shows a point of the scene."""
    (client,) = editor.server.get_clients().values()
    camera = client.camera
    back = np.array(camera.position) - np.array(camera.look_at)
    back = back / np.linalg.norm(back)
    right = np.cross(camera.up_direction, back)
    right = right / np.linalg.norm(right)
    x, y, z = np.stack([right, np.cross(back, right), back]) @ (point - np.array(camera.position))
    width, height = window.execute_script("return [innerWidth, innerHeight]")
    focal = 0.5 * height / np.tan(0.5 * camera.fov)
    return round(0.5 * width - focal * x / z), round(0.5 * height + focal * y / z)


def mouse(window, places):
    """Press the mouse at the first of the places (x, y), move it along the others, let it go."""
    from selenium.webdriver.common.actions.action_builder import ActionBuilder

    actions = ActionBuilder(window, duration=40)
    pointer = actions.pointer_action
    pointer.move_to_location(*places[0])
    pointer.pause(0.1)
    pointer.pointer_down()
    for place in places[1:]:
        pointer.move_to_location(*place)
    pointer.pointer_up()
    actions.perform()


def press(window, name):
    """Click a button of the panel."""
    (button,) = window.find_elements("xpath", f"//button[normalize-space(.)='{name}']")
    button.click()


def test_real_clicks(edited, window):
    editor, address = edited
    window.get(address)
    until(lambda: len(editor.server.get_clients()) == 1)
    until(lambda: window.find_elements("xpath", "//button[normalize-space(.)='save']"))
    time.sleep(4)  # the shapes are drawn

    def point(side, direction):
        vertices = editor.shapes[side].vertices
        return int((vertices @ np.array(direction)).argmax())

    def click(side, vertex, expected):
        mouse(window, [pixel(editor, window, editor.placed[side][vertex])])
        until(lambda: [m.vertices for m in editor.landmarks.landmarks] == expected)
        time.sleep(2)  # markers and handles are drawn: a click before that is theirs

    ends = [editor.placed[k][point(k, [x, 0, 0])] for k, x in ((0, -1), (1, 1))]
    left, right = (pixel(editor, window, end)[0] for end in ends)
    assert right - left > 0.4 * SIZE["width"]  # the shapes fill what the panel leaves

    first, second = point(0, [-0.5, 0.3, 1]), point(1, [0.3, -0.4, 1])
    click(0, first, [(first, None)])
    click(1, second, [(first, second)])
    third = point(0, [0.4, -0.5, 1])
    click(0, third, [(first, second), (third, None)])

    # the last landmark is selected: drag it to the left, by the arrow that points to the right
    x, y = pixel(editor, window, editor.placed[0][third] + [0.09, 0, 0])
    mouse(window, [(x - 5 * step, y) for step in range(13)])
    until(lambda: editor.landmarks.landmarks[1].vertices[0] != third)
    moved = editor.placed[0][editor.landmarks.landmarks[1].vertices[0]]
    assert moved[0] < editor.placed[0][third][0] - 0.05

    for button, count in (("delete", 1), ("undo", 2)):
        press(window, button)
        until(lambda count=count: len(editor.landmarks.landmarks) == count)
    press(window, "save")
    until(editor.file.exists)
    assert read_pairs(editor.file) == ([first], [second])
