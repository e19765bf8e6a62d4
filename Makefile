# make         set up and build into .venv and install
# make demo    follow a curved ramp by touch in simulation; results in out/demo     (TASK=pushing: push an object; out/pushing)
# make test    run all tests            (ARGS="test/filter -k gate" to choose)
# make lowest  run tests with the lowest versions that setup.cfg allows
# make lint    ruff, mypy and clang-format
# make docs    build the documentation into out/site
# make results-check   run benchmarks of docs/results again whose numbers depend on no clock (ARGS="--only robust")
# make model   make the shipped model again: generate simulated images, train, quantize (work in out/model)
# make lock    renew the exact versions that all of these install (scripts/constraints.txt, scripts/lowest.txt)
# make clean   remove what was built    (make distclean: .venv and out as well)
#
# PYTHON=python3.12 chooses the interpreter for .venv. TORCH=torch==2.9.1 chooses what the tests of the training install,
# as it is; left out, it is the version of scripts/requirements.py, without CUDA where there is no NVIDIA GPU.

SHELL := bash
ARGS ?=
TASK ?= surface_following
export PYTHON TORCH

# packages: what tests need to be installed
.PHONY: build demo packages test lowest lint docs results-check model lock clean distclean

build:
	@scripts/setup.sh
	@scripts/build.sh

demo: build
	@. scripts/env.sh && exec tactile demo $(TASK) --out out/$(if $(filter surface_following,$(TASK)),demo,$(TASK)) $(ARGS)

packages:
	@scripts/setup.sh test browser train cluster franka-sim

test: packages
	@scripts/build.sh
	@scripts/test.sh $(ARGS)

lowest: build
	@scripts/lowest.sh $(ARGS)

lint:
	@scripts/setup.sh lint train
	@. scripts/env.sh && ruff check . && ruff format --check . && mypy && \
	    clang-format --dry-run --Werror tactile_*/_csrc/*.[ch]

docs:
	@scripts/setup.sh docs
	@scripts/build.sh
	@scripts/docs.sh

results-check: build
	@scripts/setup.sh test
	@. scripts/env.sh && python scripts/results_check.py $(ARGS)

model:
	@scripts/setup.sh train
	@scripts/build.sh
	@. scripts/env.sh && tactile data generate out/model/data --train 6500 --val 1500 --seed 1 \
	        --config config/perception/collection_sim.yaml && rm -rf out/model/run && \
	    tactile train out/model/data --out out/model/run --config config/perception/tactip_sim.yaml && \
	    tactile quantize out/model/run --data out/model/data --install tactile_perception/models/tactip_sim.onnx

lock:
	@scripts/setup.sh lock
	@scripts/lock.sh

clean:
	rm -rf build install log docs/reference

distclean: clean
	rm -rf .venv .venv-lowest out
