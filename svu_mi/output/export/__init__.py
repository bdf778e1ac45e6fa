"""Export of results for other programs: GLB, MaterialX, Mitsuba XML, EXR and PNG."""
