"""Recordings with known truth: eye, forceps, microscope and motion of the reference rig."""
