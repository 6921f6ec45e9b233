"""What all operations share about writing: records, previews, progress, and the partition of work among processes."""
