"""``report.html``: one page about a capture and what it says, to send."""
