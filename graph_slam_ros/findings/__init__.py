"""What is wrong, said once: one table, and one record."""
