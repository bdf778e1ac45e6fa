"""What nobody saw: texels filled by likeness, or by a model, with how sure that is."""
