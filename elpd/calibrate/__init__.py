"""What a rig finds out about itself: measurements of the sensor, and the profiles that keep them."""
