"""The viewer: the shapes of a run in the browser, with points and their images marked on both; and
the editor of landmarks."""

from nsm.results.view.landmark_editor import EditedShape, LandmarkEditor
from nsm.results.view.server import Viewer, running, serving

__all__ = ["EditedShape", "LandmarkEditor", "Viewer", "running", "serving"]
