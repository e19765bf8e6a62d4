"""From an image to what the network takes and back: pre-processing, labels, presence, sources of images."""
