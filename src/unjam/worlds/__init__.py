"""Where drivers drive: the actual simulator and every view of it, behind one contract."""
