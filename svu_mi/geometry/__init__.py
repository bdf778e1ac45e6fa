"""The surface in texels, and which photograph shows which of them."""
