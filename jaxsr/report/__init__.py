"""Showing results: tables, the comparison page, video."""
