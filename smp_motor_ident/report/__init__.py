"""Results for people and for programs: JSON, YAML, and a page with figures.

The only importer of matplotlib, and only :mod:`smp_motor_ident.report.figures` does it, so
that tools that merely read or write a document start fast.
"""
