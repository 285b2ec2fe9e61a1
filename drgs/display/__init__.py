"""What people see: progress, tables and pictures."""
