# make demo      environment, then a still life made, fitted, rendered and compared: pictures in out/demo
# make test      environment, then the tests; with PYTEST_FLAGS="-q -n 2 --dist loadfile --slow" each of their cases
# make check     before a commit: form, types, and the tests that a change of the core needs; two minutes on two cores
# make numerics  the tests of images, gradients, information and extremes once more, compiled for other processors
# make smoke     each command of docs/commands.md once, on scenes that are made in seconds
# make browser   Chromium by apt, for tests of the report and the viewer that are skipped without one
# make cuda-check  on a machine with an NVIDIA card: suite, stress, gsplat, times, in one file to send back
# make docs      environment, then the documentation as a site: out/site/index.html
#
# PYTHON      interpreter for the environment, >= 3.11                     make PYTHON=python3.12 setup
# PIP_FLAGS   more options for pip. On Linux, plain PyPI has torch with CUDA (gigabytes); for the CPU build:
#             make PIP_FLAGS="--extra-index-url https://download.pytorch.org/whl/cpu" setup
# PYTEST_FLAGS  what pytest is told: two processes, a file of tests each       make PYTEST_FLAGS="-x --slow" test

PYTHON ?= python3
PIP_FLAGS ?=
PYTEST_FLAGS ?= -q -n 2 --dist loadfile
# CPU/LANES[/FEATURES] as DRGS_LLVM_TARGET takes them: packets of 4 and 8 lanes, without AVX2 and with it, as far as this
# machine has the instructions and wider packets of its own, which `make test` is compiled for.
TARGETS ?= $(shell grep -qsw fma /proc/cpuinfo && echo x86-64-v2/4/+fma; grep -qsw avx512vl /proc/cpuinfo && echo haswell/8)
NUMERICS := integrator claims extremes order tiles lenses shutter unscented features fisher gain backdrop mitsuba_preset
VENV := .venv
BIN := $(VENV)/bin
BASE := $(VENV)/.drgs-base
STAMP := $(VENV)/.drgs-installed

.PHONY: setup demo check test numerics cuda-check browser smoke docs lint llvm clean
.DEFAULT_GOAL := setup

setup: $(STAMP) llvm

# Packages of the tests, the pages and the teachers are not needed here: half of what `make setup` installs.
demo: $(BASE) llvm
	$(BIN)/drgs demo -o out/demo

# mypy runs beside the tests, which wait for compilers and processes now and then.
check: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	@$(BIN)/mypy & types=$$!; \
	$(BIN)/python -m pytest $(PYTEST_FLAGS) -m core; tests=$$?; \
	wait $$types && exit $$tests

test: setup
	$(BIN)/python -m pytest $(PYTEST_FLAGS)

# Each target in processes of its own: Dr.Jit compiles for one.
numerics: setup
	@set -e; for target in $(TARGETS); do \
	  echo "numerics compiled for $$target"; \
	  DRGS_LLVM_TARGET=$$target $(BIN)/python -m pytest $(PYTEST_FLAGS) $(NUMERICS:%=tests/test_%.py); \
	done

# gsplat compiles its kernels when they are first called, which takes minutes.
cuda-check: setup
	$(BIN)/python benchmarks/cuda/check.py -o out/cuda-check.json

browser:
	command -v chromium || command -v google-chrome || { apt-get update && apt-get install -y --no-install-recommends chromium; }

# The commands of docs/commands.md on a scene that is made in seconds; about two minutes on two cores.
smoke: setup
	$(BIN)/drgs --help
	$(BIN)/drgs info
	$(BIN)/drgs demo --quick -o out/smoke
	$(BIN)/drgs eval out/smoke/run
	$(BIN)/drgs report out/smoke/run -o out/smoke/report.html
	if $(BIN)/python -c 'from drgs.pages.sharing.npm import viewer_files; viewer_files()'; then \
	  $(BIN)/drgs share out/smoke/run -o out/smoke/scene.html; \
	else echo "no page: the viewer's code could not be fetched from npm"; fi
	$(BIN)/drgs cite out/smoke/run
	$(BIN)/drgs render out/smoke/run --frames 3 --width 64 --format png,exr,webm --depth -o out/smoke/render
	echo '{"keyframes": [{"position": [0, 0, -3], "wxyz": [1, 0, 0, 0], "fov": 50, "seconds": 0}, {"position": [1, 0, -3], "wxyz": [1, 0, 0, 0], "fov": 40, "seconds": 0.2}]}' > out/smoke/flight.json
	$(BIN)/drgs render out/smoke/run --path out/smoke/flight.json --width 64 -o out/smoke/flight.mp4
	$(BIN)/drgs render out/smoke/run --panorama --width 64 -o out/smoke/panorama.jpg
	rm -rf out/smoke/active
	$(BIN)/drgs fit out/smoke/still_life -o out/smoke/active --views active --add 2 --every 10 --max-steps 40
	$(BIN)/drgs select out/smoke/run --candidates dome --count 6 -k 2 -o out/smoke/selection.json
	$(BIN)/drgs fisher out/smoke/run --limit 2 --pose -o out/smoke/fisher
	rm -rf out/smoke/capture
	$(BIN)/drgs capture out/smoke/still_life -o out/smoke/capture --budget 30s
	$(BIN)/drgs capture --more -k 2 -o out/smoke/capture
	$(BIN)/drgs crossval out/smoke/run --limit 1 --max-pixels 768 --no-ladder -o out/smoke/crossval
	$(BIN)/drgs tradeoff out/smoke/run --limit 1 --max-pixels 768 --repeats 1 -o out/smoke/tradeoff
	$(BIN)/drgs reproduce static --scale tiny --seeds 1 --policy random --policy fisherrf -o out/smoke/reproduce
	$(BIN)/drgs stress --match "1 Gaussian"
	$(BIN)/drgs scene room -o out/smoke/room --size 64x48 --views 3 --spp 2
	rm -rf out/smoke/semantic
	$(BIN)/drgs fit out/smoke/room -o out/smoke/semantic --max-steps 40 --feature-width 8
	$(BIN)/drgs query out/smoke/semantic --class wall --threshold 0 --limit 1 -o out/smoke/query
	$(BIN)/drgs teach --help
	$(BIN)/drgs convert out/smoke/semantic out/smoke/labelled.ply --labels
	$(BIN)/drgs convert out/smoke/run out/smoke/run.spz
	$(BIN)/drgs convert out/smoke/run out/smoke/run.sog
	$(BIN)/drgs prune out/smoke/run --keep 0.5 --refit 5 -o out/smoke/small.spz
	$(BIN)/drgs mesh out/smoke/run --limit 4 --info-pixels 3000 --crop 10 -o out/smoke/mesh.glb
	$(BIN)/drgs scene kitchen -o out/smoke/kitchen --size 64x48 --cameras 3 --times 3 --spp 2
	rm -rf out/smoke/moving
	$(BIN)/drgs fit out/smoke/kitchen -o out/smoke/moving --max-steps 40 --max-gaussians 2000 --feature-width 8
	$(BIN)/drgs render out/smoke/moving --time 0..1 --frames 3 --width 48 --format webm,ply --set order=center -o out/smoke/times

# Strict: a broken link, or a page that the navigation does not name, fails.
docs: setup
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

clean:
	rm -rf $(VENV) .pytest_cache .ruff_cache .mypy_cache *.egg-info

$(BASE): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "make: Python >= 3.11 is needed, $(PYTHON) is $$($(PYTHON) --version 2>&1); use make PYTHON=..." >&2; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install $(PIP_FLAGS) -c constraints.txt -e '.[report]'
	touch $@

$(STAMP): $(BASE)
	$(BIN)/python -m pip install $(PIP_FLAGS) -c constraints.txt -e '.[dev]'
	touch $@

# Not a stamp: a library can go away, and looking takes a few hundredths of a second. A CUDA card needs no libLLVM.
llvm: $(BASE)
	@$(BIN)/python -c 'from drgs.runtime.libllvm import require_llvm; require_llvm()' 2>/dev/null \
	  || ldconfig -p 2>/dev/null | grep -q libcuda.so.1 \
	  || $(MAKE) --no-print-directory install-llvm

.PHONY: install-llvm
install-llvm:
	@set -e; \
	error=$$($(BIN)/python -c 'from drgs.runtime.libllvm import require_llvm; require_llvm()' 2>&1 | tail -n 1 | sed 's/^[A-Za-z]*Error: //'); \
	root=none; \
	if [ -z "$$DRJIT_LIBLLVM_PATH" ] && command -v apt-get >/dev/null; then \
	  if [ "$$(id -u)" = 0 ]; then root=; \
	  elif command -v sudo >/dev/null && sudo -n true 2>/dev/null; then root="sudo -n"; fi; \
	fi; \
	if [ "$$root" = none ]; then echo "$$error" >&2; exit 1; fi; \
	$$root apt-get update; \
	for version in 19 20 21 18 17; do \
	  if apt-cache show libllvm$$version >/dev/null 2>&1; then break; fi; \
	done; \
	$$root apt-get install -y libllvm$$version; \
	$(BIN)/python -c 'from drgs.runtime.libllvm import require_llvm; print("libLLVM:", require_llvm().path)'
