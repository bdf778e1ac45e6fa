"""Light of a capture, estimated from its photographs where it was not measured."""
