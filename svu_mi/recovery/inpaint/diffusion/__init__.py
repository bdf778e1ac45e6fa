"""What a diffusion model makes of what nobody knows (Sec. 5.3 of the paper)."""
