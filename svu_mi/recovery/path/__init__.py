"""Recovery by differentiable path tracing with Mitsuba."""
