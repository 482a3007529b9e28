"""The live page: experiments served on this machine while their trials run."""
