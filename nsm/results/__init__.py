"""Results: artefacts, figures, pictures and exported meshes; callbacks and loggers of trainings."""

from nsm.results.analytic import analytic_surface
from nsm.results.artifact import NeuralSurface, load_surface, save_surface
from nsm.results.baking import baked
from nsm.results.collection import SurfaceCollection, collection_metrics, load_collection
from nsm.results.collection_pictures import figures_picture, transfer_matrix_picture
from nsm.results.composed_map import ComposedMap, write_correspondences
from nsm.results.faults import warning_of_faults
from nsm.results.files import atomic_write
from nsm.results.map_metrics import planar_metrics
from nsm.results.meshes import export_mesh, export_surface
from nsm.results.metrics import overfit_metrics, pointwise_metrics, vertex_error
from nsm.results.pair_metrics import mean_log_distortion, pair_metrics
from nsm.results.pair_pictures import (
    distortion_picture,
    map_image,
    morph_pictures,
    transfer_picture,
)
from nsm.results.parameterization import Parameterization, load_parameterization
from nsm.results.pictures import (
    checkerboard_picture,
    error_picture,
    layout_image,
    parameterization_picture,
    reconstruction_image,
)
from nsm.results.pointwise import MapSequence, SurfaceMapModule
from nsm.results.reliability import Reliability, reliability_picture, write_reliability
from nsm.results.stored_map import load_surface_map
from nsm.results.surface_map import SurfaceMap
from nsm.results.tables import (
    collection_table,
    comparison_table,
    metrics_table,
    pair_table,
    warning_of_distortion,
    warning_of_folds,
    warning_of_misfit,
    warning_of_missed_landmarks,
    warning_of_no_landmarks,
    warning_of_tears,
)
from nsm.results.textured_mesh import TexturedMesh
from nsm.results.textures import checkerboard
from nsm.results.vertex_values import by_file_vertex

__all__ = [
    "SurfaceCollection",
    "collection_metrics",
    "collection_table",
    "figures_picture",
    "load_collection",
    "transfer_matrix_picture",
    "ComposedMap",
    "Reliability",
    "reliability_picture",
    "write_correspondences",
    "write_reliability",
    "SurfaceMap",
    "MapSequence",
    "SurfaceMapModule",
    "TexturedMesh",
    "baked",
    "analytic_surface",
    "by_file_vertex",
    "distortion_picture",
    "load_surface_map",
    "map_image",
    "morph_pictures",
    "pair_metrics",
    "pair_table",
    "transfer_picture",
    "warning_of_distortion",
    "warning_of_faults",
    "warning_of_folds",
    "warning_of_misfit",
    "warning_of_missed_landmarks",
    "warning_of_no_landmarks",
    "warning_of_tears",
    "NeuralSurface",
    "Parameterization",
    "atomic_write",
    "checkerboard",
    "checkerboard_picture",
    "comparison_table",
    "error_picture",
    "export_mesh",
    "export_surface",
    "layout_image",
    "load_parameterization",
    "load_surface",
    "mean_log_distortion",
    "metrics_table",
    "overfit_metrics",
    "parameterization_picture",
    "planar_metrics",
    "pointwise_metrics",
    "reconstruction_image",
    "save_surface",
    "vertex_error",
]
