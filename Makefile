# For fingers that know make; ./dev does the work and needs no make.
.PHONY: demo test bench lint setup
demo test bench lint setup:
	@./dev $@ $(ARGS)
