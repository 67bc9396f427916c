// Loaded into a process of Fast DDS, lets it take part with a certificate whose subject is empty: it
// would crash at that itself, as its peers do.  OpenSSL has nothing to read where Fast DDS asks for
// the text of the subject.

#define _GNU_SOURCE
#include <dlfcn.h>
#include <string.h>

static const char SUBJECT[] = "CN=/t";

int BIO_read(void* bio, void* to, int size)
{
    int (* read)(void*, void*, int) = (int (*)(void*, void*, int))dlsym(RTLD_NEXT, "BIO_read");
    int length = read(bio, to, size);
    if (length >= 0 || size != 1024) {
        return length;
    }
    memcpy(to, SUBJECT, sizeof SUBJECT - 1);
    return sizeof SUBJECT - 1;
}
