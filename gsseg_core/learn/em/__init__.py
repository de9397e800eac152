"""Expectation maximisation with an error model of every view."""
