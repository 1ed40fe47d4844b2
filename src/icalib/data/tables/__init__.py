"""Text tables (CSV): parsing, identification of columns, tables of each kind of sensor."""
