"""Figures of the notebooks: a module for each notebook, and the look that they share in `style`."""
