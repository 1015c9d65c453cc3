"""The online system: every stage, frame by frame (paper Sec. V)."""
