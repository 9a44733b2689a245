"""Libraries of other programs, in processes of their own: what they print, leave behind or die of stays there."""
