"""The viewer: the shapes of a run in the browser, with points and their images marked on both."""

from nsm.results.view.server import Viewer, serving

__all__ = ["Viewer", "serving"]
