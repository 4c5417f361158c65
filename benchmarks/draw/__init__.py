"""Pictures of tunnels: `kinds` of lining, an `atlas` of where walls tell the station, and a `scene` off screen."""
