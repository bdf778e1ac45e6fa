"""``report.html``: self-contained page with a capture and its estimate."""
