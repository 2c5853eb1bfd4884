"""The settings that are no group: names, types and defaults, with the help on each in Args.

``nsm --help``, the reference page, the command line's check and the defaults of a run are made
from these classes. Choices (activation, optimizer, ...) are no part of them: an option there is a
file of ``conf/`` with ``_target_``, and the signature and docstring of what it names say the rest.
"""

from __future__ import annotations

import inspect
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Union


@dataclass(frozen=True)
class Range:
    """The least and the largest value that a setting may have."""

    least: float
    largest: float = float("inf")


Count = Annotated[int, Range(1)]
Whole = Annotated[int, Range(0)]
Weight = Annotated[float, Range(0)]
Share = Annotated[float, Range(0, 1)]


class Misfit(ValueError):
    """A value that does not fit its type.

    Args:
        message: what is wrong.
        kind: ``wrong_type``, ``out_of_range`` or ``unknown_option``.
    """

    def __init__(self, message: str, kind: str = "wrong_type") -> None:
        super().__init__(message)
        self.kind = kind


def fit(value: Any, kind: Any) -> Any:
    """A value from YAML, the command line or Python as one of an annotated type.

    Whole numbers become floats, and numbers names, where the type says so. A mapping fits classes
    that YAML cannot write down, since ``_target_`` in it makes an object.

    Raises:
        Misfit: it does not fit.
    """
    origin, inside = typing.get_origin(kind), typing.get_args(kind)
    if origin is Annotated:
        value = fit(value, inside[0])
        limits = inside[1]
        if value is not None and not limits.least <= value <= limits.largest:
            bounds = f"at least {limits.least}"
            if limits.largest < float("inf"):
                bounds += f" and at most {limits.largest}"
            raise Misfit(f"{value} must be {bounds}", "out_of_range")
        return value
    if origin in (Union, types.UnionType):
        misfits = []
        for one in inside:
            try:
                return fit(value, one)
            except Misfit as misfit:
                misfits.append(misfit)
        ranges = [misfit for misfit in misfits if misfit.kind != "wrong_type"]
        raise ranges[0] if ranges else Misfit(f"{value!r} is not {described(kind)}")
    if origin is Literal:
        if value not in inside:
            raise Misfit(f"{value!r} is not one of {', '.join(map(str, inside))}", "unknown_option")
        return value
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if kind is float and number:
        return float(value)
    if kind is str and number:
        return str(value)
    if origin in (list, tuple, Sequence) and isinstance(value, (list, tuple)):
        return [fit(item, inside[0]) for item in value] if inside else list(value)
    if origin in (dict, Mapping) and isinstance(value, Mapping):
        return dict(value)
    if kind in _PLAIN or kind is type(None):
        fits = type(value) is kind
    elif inspect.isclass(kind) and not isinstance(value, Mapping):  # a mapping has a _target_
        try:
            fits = isinstance(value, kind)
        except TypeError:
            fits = True
    else:
        fits = True
    if fits:
        return value
    raise Misfit(f"{value!r} is not {described(kind)}")


_PLAIN = {
    float: "a number",
    int: "a whole number",
    bool: "true or false",
    str: "text",
    list: "a list",
    dict: "a mapping",
}


def described(kind: Any) -> str:
    """A type as users know it, without the classes that YAML cannot write down."""
    none = type(None)
    origin, inside = typing.get_origin(kind), typing.get_args(kind)
    if origin is Annotated:
        return described(inside[0])
    if origin in (Union, types.UnionType):
        known = [one for one in inside if not inspect.isclass(one) or one in _PLAIN or one is none]
        return " or ".join(dict.fromkeys(described(one) for one in known or inside))
    if origin is Literal:
        return f"one of {', '.join(map(str, inside))}"
    if origin in (list, tuple, Sequence):
        return f"a list, each item {described(inside[0])}" if inside else "a list"
    if kind is none:
        return "null"
    return _PLAIN.get(origin or kind, getattr(kind, "__name__", str(kind)))


@dataclass(frozen=True)
class Parameter:
    """A parameter of a class or function.

    Attributes:
        kind: its annotated type.
        default: its default, unless it is required.
        remark: what it is; empty: the docstring says it.
    """

    kind: Any
    default: Any = inspect.Parameter.empty
    remark: str = ""

    @property
    def required(self) -> bool:
        return self.default is inspect.Parameter.empty


def parameters(thing: Callable[..., Any]) -> tuple[dict[str, Parameter], bool]:
    """The parameters of a class or function by name, and whether it accepts any others.

    One without a signature, as some written in C are, accepts any.
    """
    try:
        signature = inspect.signature(thing)
    except (ValueError, TypeError):
        return {}, True
    try:
        function = thing.__init__ if inspect.isclass(thing) else thing  # type: ignore[misc]
        hints = typing.get_type_hints(function, include_extras=True)
    except (NameError, TypeError, AttributeError):  # annotations that cannot be resolved
        hints = {}
    known, others = {}, False
    for name, parameter in signature.parameters.items():
        if parameter.kind is parameter.VAR_KEYWORD:
            others = True
        elif parameter.kind is not parameter.VAR_POSITIONAL:
            default = parameter.default
            if type(default).__name__ == "_HAS_DEFAULT_FACTORY_CLASS":  # of a dataclass
                made: Any = next(f for f in fields(thing) if f.name == name)  # type: ignore[arg-type]
                default = made.default_factory()
            known[name] = Parameter(hints.get(name, Any), default)
    return known, others


@dataclass(frozen=True)
class Checked:
    """Base of settings that the tasks use: values that do not fit raise ValueError."""

    def __post_init__(self) -> None:
        for name, parameter in parameters(type(self))[0].items():
            try:
                object.__setattr__(self, name, fit(getattr(self, name), parameter.kind))
            except Misfit as misfit:
                raise Misfit(f"{name}: {misfit}", misfit.kind) from None


# of matrix products in a training: our name, and torch's
PRECISIONS = {"float32": "highest", "tf32": "high", "bf16": "medium"}


@dataclass
class SurfaceSettings:
    """The mesh.

    Args:
        path: your mesh file; it takes precedence over the name. ``surface=FILE`` sets it, and so
            does ``nsm FILE``.
        name: a mesh of the catalogue.
        seam_vertices: vertices, by their numbers in the file, that the cut passes through; null:
            chosen.
        cones: for domain=orbifold, four vertices, by their numbers in the file, at its cones; null:
            chosen.
        parts: of a mesh of several connected components: largest, or a number, counted from 0 by
            falling area, says which is kept; null: small ones are removed, others refused.
        repair: split cuts a mesh apart at non-manifold edges (three faces or more); null: it is
            refused.
        fill_holes: fill holes of at most so many edges for the map; true: small ones, shorter than
            half the square root of the area; exported meshes keep the holes.
        parameterization: of the mesh over Ω: slim (low distortion) or tutte; or given, of an OBJ,
            PLY or GLB file: it is cut and laid out as its texture coordinates are.
        cache: keep the prepared surface on disk, under a hash of its content.
    """

    path: str | None = None
    name: str = "terrain"
    seam_vertices: list[int] | None = None
    cones: list[int] | None = None
    parts: Literal["largest"] | Whole | None = None
    repair: Literal["split"] | None = None
    fill_holes: bool | Count = False
    parameterization: Literal["slim", "tutte", "given"] = "slim"
    cache: bool = True


@dataclass
class PhiSettings:
    """The neural surface that a map starts from.

    Args:
        path: for task=param, the run folder of a neural surface; null: one is made.
        overrides: for maps, settings of the trainings of their neural surfaces, as in
            'phi.overrides=["map=residual","seed=1"]'.
        steps: for maps, steps of these trainings at most, where they start from a least-squares
            fit; 0: those of experiment=fit, unless overrides change them; null: as many as
            task=overfit makes.
        processes: for maps of several meshes, how many are prepared at once, each by a process on a
            CPU core of its own; null: as many as there are cores.
    """

    path: str | None = None
    overrides: list[str] = field(default_factory=list)
    steps: Whole | None = 0
    processes: Count | None = None


@dataclass
class AttributesSettings:
    """Values at the vertices that a map transfers.

    Args:
        source: a .npy array with a row for each vertex of the source's mesh file.
        target: the same of the target, transferred to the source.
    """

    source: str | None = None
    target: str | None = None


@dataclass
class ProposalSettings:
    """What happens to landmarks that nsm proposes for closed meshes of genus 0.

    Args:
        strict: end with an error where the proposal is not sure, before any training.
        alternative: which proposal is taken: 0 the best, 1 the second best.
        complete: one to eight given landmarks are completed by proposed ones; to four or more, only
            where these are sure.
    """

    strict: bool = False
    complete: bool = True
    alternative: Whole = 0


@dataclass
class SeamSettings:
    """How closed meshes with landmarks are cut.

    Args:
        path: shortest or hidden paths; auto: the ones for which the domains agree best; own: each
            mesh is cut by itself, without regard to the landmarks.
        landmarks: how many landmarks the cut passes through, mutually distant ones; null: the
            number for which the domains agree best.
    """

    path: Literal["auto", "shortest", "hidden", "own"] = "auto"
    landmarks: Whole | None = None


@dataclass
class CertificationSettings:
    """What happens to a map that is not certified to be injective.

    At the end every triangle and the order of the boundary are verified; metrics.json has the
    result.

    Args:
        repair: move the vertices around flipped triangles.
        rounds: where that is not enough, so many further trainings of a tenth of the steps, with
            stronger terms.
    """

    repair: bool = True
    rounds: Whole = 2


@dataclass
class TrainerSettings:
    """Length, hardware and stopping rule of the training, and what it records.

    Args:
        max_steps: steps of the optimizer; 0: the network stays as it starts.
        accelerator: auto, cpu or gpu.
        devices: processes that share each step, each with its part of the batch on its own CPU
            core or GPU.
        stop_gradient_norm: stop when the norm of the gradient, averaged over ``stop_window``
            steps, falls below this; null: never.
        stop_norm_of: the loss whose norm is meant: mean over the batch, as it is trained; or sum,
            the mean's times the number of samples in the batch.
        stop_window: steps over which the norm is averaged.
        threads: of the CPU; the default networks are so small that one is fastest. null: what
            torch chooses, for large networks.
        precision: of matrix products: float32; or tf32 or bf16, faster and less exact, where the
            hardware has them.
        compile: compile the evaluation of the networks: half a minute at the start, then faster
            steps; without a compiler nothing changes.
        tabulated: cells a side of the tables that stand, in the training, for the surfaces at
            whose points a map arrives; figures are those of the mesh. null: the networks
            themselves.
        progress: show a progress bar.
        gradient_clip: largest norm of a step's gradient; null: no limit.
        log_every: steps between two values in the logs.
        log_pictures: pictures of the surface or map in the logs, the first before the training and
            the last at its end.
        log_meshes: the same as meshes of up to 100,000 vertices, for 3D in TensorBoard; each takes
            40 bytes a vertex.
        log_histograms: histograms of weights and gradients in TensorBoard, as evenly.
    """

    max_steps: Whole = 8000
    accelerator: Literal["auto", "cpu", "gpu"] = "auto"
    devices: Count = 1
    stop_gradient_norm: Weight | None = None
    stop_norm_of: Literal["mean", "sum"] = "mean"
    stop_window: Count = 100
    threads: Count | None = 1
    precision: Literal["float32", "tf32", "bf16"] = "float32"
    compile: bool = False
    tabulated: Count | None = None
    progress: bool = True
    gradient_clip: Weight | None = None
    log_every: Count = 25
    log_pictures: Whole = 6
    log_meshes: Whole = 2
    log_histograms: Whole = 6


@dataclass(frozen=True)
class OverfitWeights(Checked):
    """Weights of the terms of task=overfit.

    Args:
        normal: λ_n, of the mean squared difference of unit normals.
    """

    normal: Weight


@dataclass(frozen=True)
class ParamWeights(Checked):
    """Weights of the terms of task=param.

    Args:
        injectivity: λ_inv, against folds at the samples.
        triangles: against folds of the mesh triangles nearest to folding.
    """

    injectivity: Weight
    triangles: Weight


@dataclass(frozen=True)
class PairWeights(ParamWeights):
    """Weights of the terms of task=pair_map and task=collection_map.

    Args:
        injectivity: λ_inv, against folds at the samples.
        triangles: against folds of the mesh triangles nearest to folding.
        boundary: λ_B, with constraints.boundary=penalty: of points of ∂Ω that leave it.
        landmarks: λ_C, of landmarks that miss their targets.
        seam: of the gap between the images of the two sides of the source's seam.
    """

    boundary: Weight
    landmarks: Weight
    seam: Weight


@dataclass(frozen=True)
class ParamConstraints(Checked):
    """How task=param constrains its map.

    Args:
        boundary: free; apart: free, but a barrier keeps its image from meeting itself, so that the
            map is injective; or fixed: h keeps to the domain by construction and its boundary
            slides, so that the map is bijective.
        fold_every: steps between two looks for the mesh triangles nearest to folding.
        injectivity: what λ_inv weighs: exponential, of det J_h at samples that fold; or smooth, of
            det J_h where a step takes it below a third, for quasi-Newton steps. At triangles it is
            smooth.
        triangles_from: share of the steps after which the training measures distortion at triangles
            of the source's mesh, as figures do, instead of samples.
        settled: relative change of the distortion below which quasi-Newton steps at triangles end;
            0: never.
    """

    boundary: Literal["free", "apart", "fixed"]
    fold_every: Count = 25
    injectivity: Literal["exponential", "smooth"] = "exponential"
    triangles_from: Share = 1.0


@dataclass(frozen=True)
class PairConstraints(Checked):
    """How task=pair_map and task=collection_map constrain their maps.

    Args:
        boundary: exact: h keeps to the domain by construction; penalty: λ_B pulls the image of
            the boundary to ∂Ω.
        landmarks: augmented: multipliers make landmarks exact; fixed: λ_C alone.
        multiplier_every: steps between two updates of the multipliers; at triangles, each step.
        ramp: share of the steps over which landmarks and the seam come into full effect.
        ramp_of: what the ramp moves of the landmarks: targets, from where h has them at its start;
            or weights: λ_C grows from a thousandth.
        fold_margin: what the determinant of J_h must stay above at the mesh triangles.
        fold_every: steps between two looks for the mesh triangles nearest to folding.
        multipliers_from: share of the steps before the multipliers' first update.
        injectivity: what λ_inv weighs: exponential, of det J_h at samples that fold; or smooth, of
            det J_h where a step takes it below a third, for quasi-Newton steps. At triangles it is
            smooth.
        triangles_from: share of the steps after which the training measures distortion at triangles
            of the source's mesh, as figures do, instead of samples.
        settled: relative change of the distortion below which quasi-Newton steps at triangles end;
            0: never.
    """

    boundary: Literal["exact", "penalty"]
    landmarks: Literal["augmented", "fixed"]
    ramp: Share
    ramp_of: Literal["targets", "weights"] = "targets"
    multiplier_every: Count = 50
    fold_margin: Share = 0.1
    fold_every: Count = 25
    multipliers_from: Share = 0.0
    injectivity: Literal["exponential", "smooth"] = "exponential"
    triangles_from: Share = 1.0
    settled: Weight = 1e-3


@dataclass(frozen=True)
class CollectionConstraints(PairConstraints):
    """How task=collection_map constrains its maps.

    Args:
        boundary: exact: every h_i keeps to the domain by construction; penalty: λ_B pulls the image
            of the boundary to ∂Ω.
        landmarks: augmented: multipliers make landmarks exact; fixed: λ_C alone.
        multiplier_every: steps between two updates of the multipliers; at triangles, each step.
        ramp: share of the steps over which the weights of landmarks and seam rise to their values.
        fold_margin: what the determinant of J_h must stay above at the mesh triangles.
        fold_every: steps between two looks for the mesh triangles nearest to folding.
        multipliers_from: share of the steps before the multipliers' first update.
        ramp_of: what the ramp moves of the landmarks: targets, from where h_i has them at its
            start; or weights: λ_C grows from a thousandth.
        injectivity: what λ_inv weighs: exponential, of det J_h at samples that fold; or smooth, of
            det J_h where a step takes it below a third, for quasi-Newton steps. At triangles it is
            smooth.
        triangles_from: share of the steps after which quasi-Newton steps measure distortion at
            triangles of all surfaces' meshes, and move one h_i after the other.
        settled: relative change of the distortion below which these steps end; 0: never.
        pairs: sum: distortion is summed over all ordered pairs, the other terms over the surfaces;
            mean: distortion is the mean over the pairs, and the others weigh as with four surfaces.
    """

    pairs: Literal["mean", "sum"] = "mean"


@dataclass
class Settings:
    """The settings of a run outside the groups.

    Args:
        source: of task=pair_map: a mesh file, a catalogue name or the folder of a neural surface;
            an open one of genus 0 is mapped into a closed target, with four landmarks or more.
        target: the same; or an analytic surface: a name (sphere_cap, plane, ...; sphere with
            domain=orbifold, torus with domain=torus) or '{name: graph, z: 0.3*u*v}'.
        surfaces: of task=collection_map: three surfaces or more, each as source; or a pattern of
            files, 'surfaces=scans/*.ply'.
        template: of task=collection_map: a surface as source, which every other is mapped to and
            from; landmarks are numbered or named as on it.
        landmarks: a JSON file of pairs; or [FILE, FILE], .vts, .txt, .pinned, .bary, .pp or
            .json, one for each surface, or the names of meshes of the catalogue that have some; or
            pairs of vertices [[12, 40], [7, 3]]; a point [x, y, z], or a place [triangle, b0, b1,
            b2] with barycentric coordinates, stands for the vertex nearest to it, and -1 or null
            for a landmark that the surface lacks; a CSV file with a column for each surface; a
            folder with a file for each surface, of its name; auto, for
            closed meshes, in a collection those of genus 0: landmarks are proposed, as they are
            where none are given; []: none.
        isotopy_class: of task=pair_map on a closed domain, the class of maps in which the training
            begins: 0 is the likeliest. Where the map turns out wrong, the next ones are tried.
        seams: of task=param: edges along which the mesh is cut, as a list of pairs of vertices or a
            file of them; lines: the l lines of the OBJ file; uv: the borders of the islands of its
            texture coordinates. Several charts are flattened one by one and packed into an atlas.
        baselines: of task=param: compute libigl's SLIM, ARAP, LSCM and harmonic maps of the same
            cut mesh, too, for figures beside the result's. On a large mesh they take long.
        texture: of task=pair_map: an image for the source's texture coordinates; or own: the
            materials of its file. It is baked to the target, as target_textured.obj and .glb; the
            target's own texture, if it has one, to the source.
        texture_size: texels a side of the baked images.
        loss_terms: your own terms: +loss_terms.mine._target_=mypackage.MyTerm
            +loss_terms.mine.weight=0.1.
        callbacks: Lightning callbacks: +callbacks.mine._target_=mypackage.MyCallback.
        trust: modules of which classes named in files of earlier runs may be used:
            trust=[mypackage].
        seed: of the initial network and the samples: the same seed gives the same result.
        artefacts: leave pictures and exported meshes in the run folder.
        up: the axis of the mesh files that points up in pictures, and at first in the report and in
            the viewer.
        resume: the folder of an interrupted run, which goes on.
    """

    surface: SurfaceSettings = field(default_factory=SurfaceSettings)
    phi: PhiSettings = field(default_factory=PhiSettings)
    source: str | dict[str, Any] | None = None
    target: str | dict[str, Any] | None = None
    surfaces: str | list[Any] | None = None
    template: str | None = None
    landmarks: str | list[Any] | dict[str, Any] | None = None
    seams: str | list[Any] | None = None
    baselines: bool = False
    texture: str | None = None
    texture_size: Annotated[int, Range(1, 8192)] = 1024
    attributes: AttributesSettings = field(default_factory=AttributesSettings)
    proposal: ProposalSettings = field(default_factory=ProposalSettings)
    isotopy_class: Whole = 0
    seam: SeamSettings = field(default_factory=SeamSettings)
    certification: CertificationSettings = field(default_factory=CertificationSettings)
    trainer: TrainerSettings = field(default_factory=TrainerSettings)
    loss_terms: dict[str, Any] = field(default_factory=dict)
    callbacks: dict[str, Any] = field(default_factory=dict)
    trust: list[str] = field(default_factory=list)
    seed: Annotated[int, Range(0, 2**32 - 1)] = 0  # the largest that numpy takes
    artefacts: bool = True
    up: Literal["x", "y", "z", "-x", "-y", "-z"] = "y"
    resume: str | None = None


def conf_folder() -> Path:
    """The configuration: inside an installed package, or beside it in a clone."""
    package = Path(__file__).parent
    installed = package / "conf"
    return installed if installed.is_dir() else package.parent / "conf"


def parts() -> dict[str, type]:
    """The classes of the nested plain settings by key: surface, phi, trainer, ..."""
    kinds = {key: parameter.kind for key, parameter in parameters(Settings)[0].items()}
    return {key: k for key, k in kinds.items() if inspect.isclass(k) and is_dataclass(k)}
