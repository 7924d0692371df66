"""Programs that read what may kill a reader, each in a process of its own."""
