"""The ray tracer of `estimator` over batches of eyes, differentiable, on any device."""
