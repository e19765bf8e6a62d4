"""What a real cell is calibrated with: times, tip and mounting, from recordings of touches."""
