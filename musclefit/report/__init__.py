"""What a run found, summed up as one record and written as JSON and HTML text."""
