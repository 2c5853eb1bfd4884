# make demo: create .venv and compute a neural surface of real terrain.
# make test: create .venv and run linters, type checks and tests.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: demo test check docs bench bench-steps bench-maps bench-flattening bench-published bench-baselines bench-closed bench-correspondence bench-partial bench-classes bench-activation bench-speed bench-waiting bench-scale torture fuzz clean

demo: .venv/.nsm
	$(BIN)/nsm task=overfit surface=terrain
	@echo "now: . .venv/bin/activate, and then nsm mine.obj; or .venv/bin/nsm mine.obj"

test: check
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist worksteal

check: .venv/.nsm-dev
	$(BIN)/ruff check nsm hydra_plugins tests benchmarks docs
	$(BIN)/ruff format --check nsm hydra_plugins tests benchmarks docs
	$(BIN)/mypy

# Build the pages of docs/ with the reference of settings and of the API: site/index.html.
docs: .venv/.nsm-docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet
	@echo "the documentation is in site/index.html"

# Error against time, default and paper settings: about an hour. MESHES names the folder of meshes.
bench: .venv/.nsm-dev
	$(BIN)/python benchmarks/overfit.py $(if $(MESHES),--meshes $(MESHES))

# What makes training need fewer steps: a minute for each mesh and trial. MESHES as above.
bench-steps: .venv/.nsm-dev
	$(BIN)/python benchmarks/steps.py $(if $(MESHES),--meshes $(MESHES))

# Maps between the meshes in MESHES, settings one by one, and flattening compared with libigl: over
# an hour.
bench-maps: .venv/.nsm-dev
	$(BIN)/python benchmarks/maps.py $(if $(MESHES),--meshes $(MESHES))
	$(BIN)/python benchmarks/closed_maps.py $(if $(MESHES),--meshes $(MESHES))
	$(BIN)/python benchmarks/newton_steps.py $(if $(MESHES),--meshes $(MESHES))

# Flattening by the isometric and the conformal energy, with a picture: two minutes. MESHES as above.
bench-flattening: .venv/.nsm-dev
	$(BIN)/python benchmarks/maps.py --only 'energy: flattening' $(if $(MESHES),--meshes $(MESHES))

# Whole trainings by the published recipe beside the default: a quarter of an hour in the reduced
# form, FORM=full on a GPU. MESHES as above. Then one setting of its map changed at a time: a further
# quarter of an hour.
FORM ?= reduced
bench-published: .venv/.nsm-dev
	$(BIN)/python benchmarks/published.py --form $(FORM) $(if $(MESHES),--meshes $(MESHES))
	$(if $(filter reduced,$(FORM)),$(BIN)/python benchmarks/published_changes.py $(if $(MESHES),--meshes $(MESHES)))

# A pair of animals by every means, with a picture: three minutes. MESHES as above.
bench-baselines: .venv/.nsm-dev
	$(BIN)/python benchmarks/baselines.py $(if $(MESHES),--meshes $(MESHES))

# Closed surfaces on the disc and on the orbifold, default settings: ten minutes. MESHES as above.
bench-closed: .venv/.nsm-dev
	$(BIN)/python benchmarks/closed_surfaces.py $(if $(MESHES),--meshes $(MESHES))

# Correspondences with no landmarks or few, errors at annotated ones, beside peers (nsm[peers]).
# Some hours, or PAIRS=12 of the animals. It goes on where it stopped. MESHES as above.
bench-correspondence: .venv/.nsm-dev
	$(BIN)/python benchmarks/correspondence.py $(if $(MESHES),--meshes $(MESHES)) \
	  $(if $(PAIRS),--pairs $(PAIRS))

# Pieces cut from shapes, mapped into the whole ones and into others: half an hour. It goes on where
# it stopped. MESHES as above.
bench-partial: .venv/.nsm-dev
	$(BIN)/python benchmarks/partial.py $(if $(MESHES),--meshes $(MESHES))

# Maps between two poses of 16 classes of shapes by formula, with many landmarks, two and none, as a
# user runs them: an hour. It goes on where it stopped.
bench-classes: .venv/.nsm-dev
	$(BIN)/python benchmarks/classes.py

# The sweep of activations, with close-ups and a report on the runs: a quarter of an hour.
bench-activation: .venv/.nsm-dev
	$(BIN)/python benchmarks/activation.py $(if $(MESHES),--meshes $(MESHES))

# The command on difficult meshes, files and disks: ten minutes on two cores.
torture: .venv/.nsm-dev
	$(BIN)/python benchmarks/torture

# Fuzz each reader of files for FUZZ_SECONDS; test each property on FUZZ_EXAMPLES times the examples
# of the tests.
FUZZ_SECONDS ?= 60
FUZZ_TARGETS ?= obj off ply stl gltf glb config pairs landmarks picked barycentric surface map pair collection checkpoint
FUZZ_EXAMPLES ?= 20
fuzz: .venv/.nsm-dev
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[fuzz]'
	for target in $(FUZZ_TARGETS); do \
	  $(BIN)/python benchmarks/fuzz.py $$target $(FUZZ_SECONDS) || exit 1; done
	NSM_EXAMPLES=$(FUZZ_EXAMPLES) $(BIN)/python -m pytest -n auto tests/test_properties.py \
	  tests/test_corpus.py tests/energies tests/maps

# Cost of a step and time to an error, compared with the published recipe and settings: ten minutes;
# on the GPU where there is one.
bench-speed: .venv/.nsm-dev
	$(BIN)/python benchmarks/speed.py

# CPU seconds of each stage from raw files to the last file written, and peers by the same figures:
# ten minutes. PEER is the command of another mapper (see benchmarks/peers.py). MESHES as above.
bench-waiting: .venv/.nsm-dev
	$(BIN)/python benchmarks/waiting.py --meshes $(or $(MESHES),../shared/meshes)
	$(BIN)/python benchmarks/peers.py --meshes $(or $(MESHES),../shared/meshes) \
	  $(if $(PEER),--command '$(PEER)')

# Time and memory of meshes of a million faces and of a collection of 20 surfaces: half an hour.
bench-scale: .venv/.nsm-dev
	$(BIN)/python benchmarks/scale.py

.venv/bin/python:
	$(PYTHON) -m venv .venv

.venv/.nsm: pyproject.toml constraints.txt | .venv/bin/python
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable .
	touch $@

.venv/.nsm-dev: pyproject.toml constraints.txt | .venv/bin/python
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev,brain,docs,joblib,optuna]'
	touch $@ .venv/.nsm

.venv/.nsm-docs: pyproject.toml constraints.txt | .venv/bin/python
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[docs]'
	touch $@ .venv/.nsm

clean:
	rm -rf .venv build dist site .pytest_cache .mypy_cache .ruff_cache
