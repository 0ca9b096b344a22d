"""What can be told of a run before it: cameras, overlap, image quality, residuals, memory and time."""
