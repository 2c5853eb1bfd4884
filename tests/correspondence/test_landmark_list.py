"""Landmarks placed by hand: what is added, moved, removed, undone and written."""

from hypothesis import given
from hypothesis import strategies as st
from thorough import examples

from nsm.correspondence.landmark_list import LandmarkList
from nsm.surfaces.landmark_files import read_collection, read_names, read_pairs

CHANGES = st.lists(
    st.tuples(
        st.sampled_from(["place", "move", "delete", "rename", "undo"]),
        st.integers(0, 5),
        st.integers(0, 2),
        st.integers(0, 6),
    ),
    max_size=25,
)


def apply(marks, change):
    kind, number, shape, vertex = change
    there = number < len(marks.landmarks)
    if kind == "place":
        marks.place(shape, vertex)
    elif kind == "undo":
        marks.undo()
    elif there and kind == "move":
        marks.move(number, shape, vertex)
    elif there and kind == "delete":
        marks.delete(number)
    elif there:
        marks.rename(number, f"name {vertex}")


@given(CHANGES)
@examples(60)
def test_whatever_is_done_vertices_and_names_stay_distinct_and_undo_takes_it_back(changes):
    marks = LandmarkList(3, [[0, 1], [2, 3], [4, 5]], ["nose", "tail"])
    states = []
    for change in changes:
        before = list(marks.landmarks)
        apply(marks, change)
        if change[0] != "undo" and marks.landmarks != before:
            states.append(before)
        names = [mark.name for mark in marks.landmarks]
        assert len(set(names)) == len(names) and all(names)
        for k in range(3):
            placed = [m.vertices[k] for m in marks.landmarks if m.vertices[k] is not None]
            assert len(set(placed)) == len(placed)
    if all(change[0] != "undo" for change in changes):
        while marks.undo():
            pass
        assert [m.name for m in marks.landmarks] == ["nose", "tail"]
        assert [m.vertices for m in marks.landmarks] == [(0, 2, 4), (1, 3, 5)]


def test_clicks_on_each_shape_in_turn_make_a_landmark():
    marks = LandmarkList(2)
    assert [marks.place(0, 7), marks.place(0, 8), marks.place(1, 9), marks.place(1, 4)] == [
        0,
        1,
    ] * 2
    assert marks.place(0, 8) == 1  # is there already
    assert not marks.move(0, 1, 4) and marks.move(0, 1, 5)
    marks.place(0, 3)
    assert marks.complete() == (["1", "2"], [[7, 8], [5, 4]])


def test_what_is_saved_is_read_by_the_tasks(tmp_path):
    for count, read in ((2, read_pairs), (4, read_collection)):
        marks = LandmarkList(count, [[k, k + 10] for k in range(count)], ["nose", "tail"])
        marks.place(0, 30)  # not on all shapes: left out
        file = tmp_path / "pairs.json"
        file.write_text(marks.to_json())
        assert list(read(file)) == [[k, k + 10] for k in range(count)]
        assert read_names(file) == ["nose", "tail"]
