"""Recovery by Mitsuba's own loop: render batches of pixels, compare, differentiate."""
