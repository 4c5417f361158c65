"""Reading: one file per format, from bytes to timed scans, chunks of a registered cloud, or points of rings.

`detect` decides which file reads an input. Readers raise `ValueError` with position and cause; the three fronts
(`scene.recording`, `cloudfile`, `ringsurvey`) turn whatever a reader or its library raises into one `RecordingError`
that names the file.
"""
