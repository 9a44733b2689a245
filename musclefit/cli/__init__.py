"""The command line: reads, calls one pipeline function, writes."""
