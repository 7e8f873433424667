"""Plans: enrollment, identification, trays of objects, and the empty-table image, as generators of events."""
