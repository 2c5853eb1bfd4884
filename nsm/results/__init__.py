"""Results: saved artefacts, figures, pictures, exported meshes and what goes along a training."""

from nsm.results.artifact import NeuralSurface, load_surface, save_surface
from nsm.results.files import atomic_write
from nsm.results.meshes import export_mesh
from nsm.results.metrics import overfit_metrics, vertex_error
from nsm.results.pictures import checkerboard_picture, error_picture, reconstruction_image
from nsm.results.tables import metrics_table
from nsm.results.textures import checkerboard

__all__ = [
    "NeuralSurface",
    "atomic_write",
    "checkerboard",
    "checkerboard_picture",
    "error_picture",
    "export_mesh",
    "load_surface",
    "metrics_table",
    "overfit_metrics",
    "reconstruction_image",
    "save_surface",
    "vertex_error",
]
