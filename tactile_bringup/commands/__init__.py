"""The commands of tactile, one file each."""
