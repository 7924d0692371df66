# make setup | demo | test | check | docs | pictures | paper | clean. Each but clean sets up first, which is skipped when it is done.
# PYTHON=/path/to/python3 chooses the Python (3.10 to 3.13); ARGS="..." is passed on to demo, test, pictures and paper.
SHELL := bash
ROOT := $(patsubst %/,%,$(dir $(abspath $(lastword $(MAKEFILE_LIST)))))
IN := cd '$(ROOT)' && . ./setup.bash &&

.PHONY: setup demo test check format docs pictures paper lock clean

setup:
	@PYTHON='$(PYTHON)' '$(ROOT)/scripts/setup.sh'

demo: setup
	@$(IN) exec demo $(ARGS)

# Everything runs on two cores but what is marked as alone: it tells less on a machine that is busy.
# Tests of live nodes stay together by file, the longest files first.
SHARED := python -m pytest -n 2
test: setup
ifdef ARGS
	@$(IN) exec python -m pytest $(ARGS)
else
	@$(IN) failed=0; \
	$(SHARED) --dist worksteal --durations=10 --ignore=test/nodes --ignore=test/system || failed=1; \
	python -m pytest --durations=5 -m alone test/system || failed=1; \
	$(SHARED) --dist loadfile --no-loadscope-reorder --durations=20 -m 'not long and not alone' test/system test/nodes && exit $$failed
endif

check: setup
	@$(IN) exec scripts/check.sh

format: setup
	@$(IN) ruff format && ruff check --fix

docs: setup
	@$(IN) sphinx-build -q docs docs/_build/html && echo "docs: $(ROOT)/docs/_build/html/index.html"

# Draw the pictures of the pages anew (minutes; needs Chromium).
pictures: setup
	@$(IN) exec python scripts/pictures.py $(ARGS)

paper: setup
	@$(IN) exec python benchmarks/paper.py $(ARGS)

# Resolve the pins of requirements/*.in anew (needs uv, and only when they are to change).
lock:
	@cd '$(ROOT)' && exec scripts/lock.sh $(ARGS)

clean:
	@cd '$(ROOT)' && rm -rf .venv build install log .mypy_cache .pytest_cache .ruff_cache .import_linter_cache .hypothesis docs/_build
