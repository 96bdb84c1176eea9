"""What ``tools/throughput.py`` measures: streams to run on, our kernels, and what others offer."""
