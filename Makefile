# make setup | demo | test | check | docs | paper | clean. Each but clean sets up first, which is skipped when it is done.
# PYTHON=/path/to/python3 chooses the Python (3.10 to 3.13); ARGS="..." is passed on to demo, test and paper.
SHELL := bash
ROOT := $(patsubst %/,%,$(dir $(abspath $(lastword $(MAKEFILE_LIST)))))
IN := cd '$(ROOT)' && . ./setup.bash &&

.PHONY: setup demo test check format docs paper lock clean

setup:
	@PYTHON='$(PYTHON)' '$(ROOT)/scripts/setup.sh'

demo: setup
	@$(IN) exec demo $(ARGS)

# What computes runs on two cores; what runs in real time has the machine to itself.
test: setup
ifdef ARGS
	@$(IN) exec python -m pytest $(ARGS)
else
	@$(IN) python -m pytest -n 2 --dist loadfile --durations=10 --ignore=test/nodes --ignore=test/system; pure=$$?; \
	python -m pytest --durations=20 test/nodes test/system && exit $$pure
endif

check: setup
	@$(IN) exec scripts/check.sh

format: setup
	@$(IN) ruff format && ruff check --fix

docs: setup
	@$(IN) sphinx-build -q docs docs/_build/html && echo "docs: $(ROOT)/docs/_build/html/README.html"

paper: setup
	@$(IN) exec python benchmarks/paper.py $(ARGS)

# Resolve the pins of requirements/*.in anew (needs uv, and only when they are to change).
lock:
	@cd '$(ROOT)' && exec scripts/lock.sh $(ARGS)

clean:
	@cd '$(ROOT)' && rm -rf .venv build install log .mypy_cache .pytest_cache .ruff_cache .import_linter_cache .hypothesis docs/_build
