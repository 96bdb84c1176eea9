"""What the events say: sums, references, tests and estimates. No clock, no device, no log in here."""
