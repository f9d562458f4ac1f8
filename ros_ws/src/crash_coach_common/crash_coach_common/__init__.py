"""The common floor: what simulator, coach and policies all stand on."""
