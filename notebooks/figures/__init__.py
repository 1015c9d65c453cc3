"""Every plot of the workbench, one look: a module for each notebook, the style they share in `style`."""
