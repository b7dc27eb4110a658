# The verbs of the project.  Each does its own set-up; `make help` lists them.
# Arguments go through ARGS:  make demo ARGS="--frames 96 --size 640x360"

PYTHON := .venv/bin/python
ARGS ?=
RESULTS := tests/benchmarks/results
# Those that keep time need the machine for themselves; the others share it.
USUAL := -m "not clock and not slow and not gpu"
ALONE := -m "clock and not slow and not gpu"
BESIDE := -n auto --maxprocesses 4 --dist loadfile
NONE := test $$? -eq 5 # ARGS may choose none of these tests
# soak takes 30 minutes; gpu needs a hardware GPU, witness a path tracer
BENCHES := $(filter-out gpu soak witness,$(patsubst tests/benchmarks/bench_%.py,%,$(sort $(wildcard tests/benchmarks/bench_*.py))))

.DEFAULT_GOAL := help
.PHONY: demo docs web test test-training test-examples test-batch-ray test-headset test-web validate witness gl-witness gpu-kit check clean help setup setup-test setup-training setup-examples setup-batch-ray setup-page setup-docs setup-web setup-witness

demo: setup  ## stream two scenes through six eyes; writes out/demo/
	$(PYTHON) -m filter_service demo $(ARGS)

web: setup-page  ## a page in your browser: your prescription, your photo
	$(PYTHON) -m filter_service web $(ARGS)

docs: setup-docs  ## the documentation, checked strictly; writes out/docs/
	NO_MKDOCS_2_WARNING=1 .docs/bin/python -m mkdocs build --quiet --strict $(ARGS)

test: setup-test  ## all tests but the slow ones and those for a hardware GPU
	$(PYTHON) -m pytest $(USUAL) $(BESIDE) tests/unit tests/numerical $(ARGS) || $(NONE)
	$(PYTHON) -m pytest $(USUAL) $(BESIDE) tests/end_to_end $(ARGS) || $(NONE)
	$(PYTHON) -m pytest $(ALONE) tests/end_to_end $(ARGS) || $(NONE)

test-training: setup-training  ## the tests of the training, with torch, and a short run
	$(PYTHON) -m pytest tests/training $(ARGS)

test-batch-ray: setup-batch-ray  ## `ocufilter batch` on two workers of a Ray cluster
	.batch_ray/bin/python -m pytest tests/batch_ray $(ARGS)

test-examples: setup-examples  ## the notebook, in an environment as a user has it
	.examples/bin/python -m pytest -c /dev/null --rootdir . -p no:cacheprovider tests/examples $(ARGS)

test-headset:  ## `ocufilter headset` against a real OpenXR runtime, in a root of its own
	@sh tests/headset/setup_root.sh
	sh tests/headset/run_in_root.sh python -m pytest tests/headset $(ARGS)

test-web: setup-web  ## `ocufilter web` in a real browser (Chromium, headless)
	$(PYTHON) -m pytest tests/web $(ARGS)

validate: setup-test setup-web  ## the slow tests, and every benchmark table as JSON
	$(PYTHON) -m pytest -m "slow and not gpu" --ignore tests/training $(ARGS)
	mkdir -p $(RESULTS) out
	for bench in $(BENCHES); do \
	    $(PYTHON) -m filter_service bench $$bench --json > out/$$bench.json && \
	    $(PYTHON) -m json.tool --indent 1 out/$$bench.json $(RESULTS)/$$bench.json \
	    || exit 1; \
	done
	for how in ipc shm curve tcp; do for eyes in mono stereo; do \
	    case $$eyes in mono) many="--rate-hz 10";; stereo) many="--stereo --rate-hz 3";; esac; \
	    $(PYTHON) -m filter_service bench roundtrip --transport $$how $$many \
	        --json > out/roundtrip.json && $(PYTHON) -m json.tool --indent 1 \
	        out/roundtrip.json $(RESULTS)/roundtrip_$${how}_$$eyes.json || exit 1; \
	done; done
	$(PYTHON) -m tests.benchmarks.bench_wavefront

witness: setup-witness  ## our frames against a path tracer through the same eyes
	$(PYTHON) -m tests.benchmarks.bench_witness $(ARGS)

gpu-kit: setup  ## a folder for a GPU machine without a network; writes out/gpu_kit/
	@PYTHON=$(PYTHON) PYTHON_VERSION="$(PYTHON_VERSION)" WITH="$(WITH)" \
	    sh tests/gpu_kit/make.sh $(ARGS)

gl-witness: setup-test  ## the renderer on two OpenGL drivers, and Vulkan's layers on it
	@sh tests/gl_witness/setup.sh drivers
	$(PYTHON) -m tests.gl_witness $(ARGS)

check: setup  ## lint, formatting, types, and every shader through glslang
	$(PYTHON) -m ruff check .
	$(PYTHON) -m ruff format --check .
	$(PYTHON) -m mypy
	@sh tests/gl_witness/setup.sh glslang || test $$? -eq 77
	$(PYTHON) -m tests.shader_check

clean:  ## remove what the other targets made, .venv included; out/ stays
	rm -rf .venv .witness .batch_ray .docs .examples .gl_witness .headset build *.egg-info .pytest_cache .ruff_cache .mypy_cache .hypothesis clients/js/node_modules
	find filter_service -name '_*.so' -delete
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

help:  ## this list
	@sed -n 's/^\([a-z-]*\):.*  ## \(.*\)/  make \1\t\2/p' $(MAKEFILE_LIST) | expand -t 18

setup:
	@sh setup.sh

setup-test:
	@sh setup.sh test

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

setup-witness:
	@sh setup.sh witness
