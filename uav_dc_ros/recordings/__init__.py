"""What bags report of missions: bags of any recorder that has the topics."""
