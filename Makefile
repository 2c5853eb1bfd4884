# make demo: environment and a neural surface of real terrain; make test: environment and tests.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: demo test check docs bench bench-steps bench-maps bench-activation bench-speed bench-scale torture fuzz clean

demo: .venv/.nsm
	$(BIN)/nsm task=overfit surface=terrain

test: check
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2

check: .venv/.nsm-dev
	$(BIN)/ruff check nsm hydra_plugins tests benchmarks docs
	$(BIN)/ruff format --check nsm hydra_plugins tests benchmarks docs
	$(BIN)/mypy

# The pages of docs/, the reference of settings made of conf/, the API: site/index.html.
docs: .venv/.nsm-docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet
	@echo "the documentation is in site/index.html"

# Error against time, default beside paper settings: about an hour. MESHES names the folder.
bench: .venv/.nsm-dev
	$(BIN)/python benchmarks/overfit.py $(if $(MESHES),--meshes $(MESHES))

# What makes a training need fewer steps: a minute for each mesh and trial. MESHES as above.
bench-steps: .venv/.nsm-dev
	$(BIN)/python benchmarks/steps.py $(if $(MESHES),--meshes $(MESHES))

# Maps between the meshes of the folder MESHES, and flattening beside libigl's: over an hour.
bench-maps: .venv/.nsm-dev
	$(BIN)/python benchmarks/maps.py $(if $(MESHES),--meshes $(MESHES))

# Each activation in one network, its wrinkles, and a report on the runs: half an hour.
bench-activation: .venv/.nsm-dev
	$(BIN)/python benchmarks/activation.py $(if $(MESHES),--meshes $(MESHES))

# The command on hostile meshes, files and disks: ten minutes on two cores.
torture: .venv/.nsm-dev
	$(BIN)/python benchmarks/torture

# Each reader of files is fuzzed for so many seconds; each property is tried on so many times the
# examples of the tests.
FUZZ_SECONDS ?= 60
FUZZ_TARGETS ?= obj off ply stl gltf glb config pairs landmarks surface map pair collection checkpoint
FUZZ_EXAMPLES ?= 20
fuzz: .venv/.nsm-dev
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[fuzz]'
	for target in $(FUZZ_TARGETS); do \
	  $(BIN)/python benchmarks/fuzz.py $$target $(FUZZ_SECONDS) || exit 1; done
	NSM_EXAMPLES=$(FUZZ_EXAMPLES) $(BIN)/python -m pytest -n auto tests/test_properties.py \
	  tests/test_corpus.py tests/energies tests/maps

# Cost of a step and time to an error, ours beside the published recipe and settings: ten minutes;
# on the GPU where there is one. MESHES adds what a user waits for with bunny and animals.
bench-speed: .venv/.nsm-dev
	$(BIN)/python benchmarks/speed.py $(if $(MESHES),--meshes $(MESHES))

# Meshes of a million faces and a collection of 20 surfaces, time and memory: half an hour.
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
