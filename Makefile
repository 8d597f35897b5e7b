# `make help` says what there is. Everything that needs setting up sets itself up first (scripts/setup.sh).
SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c
.DEFAULT_GOAL := help
.SILENT:
.NOTPARALLEL:
.PHONY: help setup demo test security long check lint formatted types contracts house unit format lock images ray flower train docs bundle install uninstall clean ready

# Taken as it is, without make expanding "$", and given on in the environment: any text may stand in it.
override ASK := $(value ASK)
export ASK

RUN := scripts/as_user.sh
PYTEST := $(RUN) python -m pytest -p no:cacheprovider  # nothing is written into the tree
TUI_FLAG := $(if $(filter-out 0 no false,$(TUI)),--tui)

help: ## This list
	awk 'BEGIN { FS = ":.*## " } /^[a-z]+:.*## / { printf "  make %-10s %s\n", $$1, $$2 }' $(firstword $(MAKEFILE_LIST))
	printf '\n  ASK="fetch the red box" make demo    adds an instruction (or: make demo ASK="…")\n  make demo TUI=1                      opens the terminal UI on the running fleet\n'

setup: ## Everything a gateway needs on this machine (as root: service user; otherwise in .venv, with sudo)
	scripts/setup.sh gateway

demo: setup ## Start a fleet, run instructions on it, replay its log
	$(RUN) swiftbot demo $${ASK:+"--ask=$$ASK"} $(TUI_FLAG)

test: ## Set up and run the tests: lint, types, import contracts, unit, integration and replay tests but the long ones
	scripts/setup.sh dev --with-browser
	$(MAKE) --no-print-directory lint formatted types contracts READY=1
	scripts/whole_suite.sh -m 'not long' tests/unit tests/reports tests/replay tests/integration tests/security

security: ## Set up and run the attacks: what somebody without keys, with a stolen or another's certificate tries
	scripts/setup.sh dev
	scripts/whole_suite.sh tests/security

long: ## Set up and run the long tests
	scripts/setup.sh dev --with-browser --with-prometheus
	$(MAKE) --no-print-directory docs
	scripts/whole_suite.sh -m long tests/unit tests/reports tests/replay tests/integration tests/security

# Types and tests take longest, and neither needs the other: at the same time.
check: ready ## The fast part: lint, types, import contracts, unit tests but the long ones, with few examples of each property
	$(MAKE) --no-print-directory lint formatted contracts READY=1
	report=$$(mktemp); trap 'rm -f "$$report"' EXIT; failed=0; \
	$(RUN) basedpyright --level error >"$$report" 2>&1 & types=$$!; \
	SWIFTBOT_QUICK=1 $(PYTEST) --numprocesses 6 --dist worksteal tests/unit || failed=$$?; \
	wait "$$types" || { cat "$$report" >&2; failed=1; }; \
	exit "$$failed"

ready:
	$(if $(READY),:,scripts/setup.sh dev --without-images)

lint: ready ## Ruff: rules
	$(RUN) ruff check --quiet .

formatted: ready ## Ruff: format, checked only
	$(RUN) ruff format --check --quiet . || { echo 'not formatted: make format' >&2; exit 1; }

types: ready ## Basedpyright, strict
	$(RUN) basedpyright --level error

contracts: ready ## Import-linter: imports go downward only
	$(RUN) lint-imports --no-cache

house: ## Sizes: lines of code, modules, import chains, words to take out
	/usr/bin/python3 scripts/house.py

unit: ready ## Unit tests
	$(PYTEST) tests/unit

format: ready ## Ruff: fix what it can and format, in this tree
	. scripts/common.sh && "$$VENV/bin/ruff" check --fix --quiet . ; "$$VENV/bin/ruff" format .

lock: ready ## Pin the dependencies in locks/ again (UPGRADE=1: newest versions)
	. scripts/common.sh && export UV_SYSTEM_CERTS=1 && compile() { \
	  "$$TOOLS/bin/uv" pip compile --quiet --python /usr/bin/python3 --generate-hashes --no-emit-index-url --no-header --no-annotate $(if $(UPGRADE),--upgrade) "$$@"; }; \
	compile pyproject.toml -o locks/gateway.txt && \
	compile pyproject.toml --group dev -c locks/gateway.txt --override locks/without.in -o locks/dev.txt && \
	compile locks/tools.in -o locks/tools.txt && \
	compile locks/docs.in -o locks/docs.txt && \
	compile pyproject.toml --extra train -c locks/gateway.txt -o locks/train.txt && \
	/usr/bin/python3 -c 'import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["project"]["optional-dependencies"]["report"], sep="\n")' \
	  | compile - -c locks/gateway.txt -o locks/report.txt && \
	compile pyproject.toml --extra foxglove -c locks/gateway.txt -o locks/foxglove.txt && \
	/usr/bin/python3 -c 'import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["project"]["optional-dependencies"]["flower"], sep="\n")' \
	  | compile - -o locks/flower.txt && \
	/usr/bin/python3 -c 'import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["project"]["optional-dependencies"]["bench"], sep="\n")' \
	  | compile - -o locks/bench.txt

images: setup ## Build the container images (setup does so too)
	$(RUN) swiftbot images build

ray: ## Ray, which `swiftbot bench startup` compares with, in an environment of its own (220 MB)
	scripts/setup.sh gateway --without-images --with-ray

flower: ## Flower, which `swiftbot bench learn` compares with, in an environment of its own (5 GB)
	scripts/setup.sh gateway --without-images --with-flower

docs: ## The documentation as a site in build/docs, its links checked
	scripts/setup.sh gateway --without-images --with-docs
	. scripts/common.sh && NO_MKDOCS_2_WARNING=1 "$$DOCS/bin/mkdocs" build --quiet --strict --site-dir "$$PROJECT/build/docs"
	echo build/docs/index.html

train: ## What `swiftbot train` needs (PyTorch), in an environment of its own (5 GB)
	scripts/setup.sh gateway --without-images --with-train

bundle: setup ## One signed file that installs without a network (KEY=file of `swiftbot release key`, OUT=file, MODELS=, PARTS=)
	KEY="$(KEY)" OUT="$(OUT)" MODELS="$(MODELS)" PARTS="$(PARTS)" scripts/bundle.sh

install: ## Install as systemd services on this machine (DESTDIR=… for a package)
	DESTDIR="$(DESTDIR)" scripts/install.sh

uninstall: ## Take the services out again (PURGE=1: data too)
	DESTDIR="$(DESTDIR)" PURGE="$(PURGE)" scripts/uninstall.sh

clean: ## Remove what builds and tests left in this tree
	rm -rf dist .ruff_cache .hypothesis .import_linter_cache
	find . -path ./.venv -prune -o -name __pycache__ -type d -print0 | xargs -0 rm -rf
