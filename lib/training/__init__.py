"""Training of the landmark detector: data, augmentation, losses, the loop, its stages, evaluation, error models, assembly."""
