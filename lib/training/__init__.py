"""Training of the landmark detector: samples, augmentation, losses, the loop, evaluation and assembly."""
