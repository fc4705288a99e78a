"""What sees the whole run: launching, recording, viewing, the command line."""
