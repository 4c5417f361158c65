"""One run on many devices, or in many processes."""
