"""The viewer: a run's shapes in the browser, where a point picked on one is seen on the other."""

from nsm.results.view.server import Viewer, serving

__all__ = ["Viewer", "serving"]
