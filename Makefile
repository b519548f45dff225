# A fresh Debian or Ubuntu machine needs no more than `make bench` and `make test`.
BIN := .venv/bin
TESTS := $(BIN)/pytest -n auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder

.PHONY: help setup setup-dev bench quick record test docs fuzz fuzz-short combinations faults mutants lint format clean

help:
	@echo 'make bench   set up, then fuse the built-in city with Open3D: semstab-bench --backend open3d'
	@echo 'make test    set up, then lint, types and import contract beside a minute of damaged files, and the test suite'
	@echo 'make quick   between edits, a minute at most: ruff, and the tests of what changed since the last commit'
	@echo 'make record  run the suite under coverage.py, and note which tests call which function: make quick and make mutants begin with these'
	@echo 'make fuzz    damage files of every kind for an hour (FUZZ_SECONDS=3600 FUZZ_SEED=1); fuzz-short: the same 10,000 inputs everywhere'
	@echo 'make combinations  the tests that make test leaves out: combinations of what it tests one by one; make fuzz begins with them'
	@echo 'make faults  kill 315 runs (of 30 scenes, over videos, too), studies, predictions, exports and conversions (FAULTS=315), fill their disk, and see that nothing is lost'
	@echo 'make mutants  change 100 lines of the product, one at a time (MUTANTS="--lines 100 --seed 0"), and say which the tests find'
	@echo 'make docs    build the documentation into site/, warnings are errors; type its tutorials, and the examples of the help, as they stand'
	@echo 'make setup   the set-up alone: system libraries, .venv, semstab; make setup-dev: and what the tests need'
	@echo 'make format  let ruff format and mend the code'
	@echo 'make clean   remove .venv and what tools left behind'

setup:
	@scripts/setup.sh

setup-dev:
	@scripts/setup.sh dev

bench: setup
	$(BIN)/semstab-bench --backend open3d

test: setup-dev
	$(MAKE) --no-print-directory -j2 --output-sync=target lint fuzz-short
	$(TESTS) --ignore tests/docs

quick: setup-dev
	@$(BIN)/ruff check --quiet .
	@$(BIN)/ruff format --check --quiet .
	@$(BIN)/python scripts/quick.py

record: setup-dev
	$(BIN)/python scripts/recorded.py

docs: setup-dev
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict
	$(TESTS) tests/docs

FUZZ_SECONDS := 3600
FUZZ_SEED := 1
fuzz: combinations
	$(BIN)/python tests/fuzz/fuzz.py --seconds $(FUZZ_SECONDS) --seed $(FUZZ_SEED)

combinations: setup-dev
	$(TESTS) -m combination --ignore tests/docs

fuzz-short: setup-dev
	$(BIN)/python tests/fuzz/fuzz.py --inputs 10000 --seconds 300 --seed 1

faults: setup-dev
	$(BIN)/python tests/faults/kills.py $(or $(FAULTS),315)
	$(BIN)/python tests/faults/disk.py 12
	$(BIN)/python tests/faults/forgeries.py results city@1 sim-soft
	$(BIN)/python tests/faults/forgeries.py results city@1 trick-world-locked
	$(BIN)/python tests/faults/forgeries.py results livingroom@1 dicenet-0.2
	$(BIN)/python tests/faults/forgeries.py results apc_shelf@1 fcn-scores

MUTANTS := --lines 100 --seed 0
mutants: setup-dev
	nice -n 5 $(BIN)/python scripts/mutate.py $(MUTANTS)

lint: setup-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/python scripts/plain.py
	$(BIN)/mypy
	$(BIN)/lint-imports

format: setup-dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf .venv build dist site *.egg-info .mypy_cache .ruff_cache .pytest_cache .import_linter_cache .hypothesis
