"""What may be done with a map: its ceiling, its verdict, which places flip, which labels may be acted on."""
