// Asks Fast DDS, many times in one process, what signed documents let an identity do.
//
// Reads cases from standard input, a line each, of fields separated by tabs:
//
//   IDENTITY_FOLDER  DOCUMENTS_FOLDER  DOMAIN  TIME_ZONE  PEER_IDENTITY|-  PEER_DOCUMENTS|-  WAIT_MS
//   QUESTION...
//
// A question is "publish" or "subscribe", the topic and the partitions, separated by
// the character US (0x1f).  Answers each case with a line, flushed, of fields separated by tabs:
//
//   refused  LOG                      no participant
//   peer refused  LOG                 none with the identity of the peer
//   joined  ANSWER...                 to each question: denied, created, matched or unmatched
//
// With a peer, "created" becomes "matched" if the counterpart of the peer is found within WAIT_MS,
// else "unmatched"; "peer denied" if the peer may not open it.  The line that lacks when the process
// ends is that of the case at which it crashed.
//
// With a domain as argument, it is the program of fastdds_probe.hpp; with a domain and a folder, a
// participant of this enclave: it says joined, and logs, until standard input ends.

#include "fastdds_probe.hpp"

#include <fastdds/dds/log/Log.hpp>

#include <stdio.h>
#include <unistd.h>

#include <chrono>
#include <cstdint>
#include <cstdlib>
#include <ctime>
#include <filesystem>
#include <fstream>
#include <functional>
#include <iostream>
#include <memory>
#include <mutex>
#include <sstream>
#include <string>
#include <thread>
#include <vector>

// Keeps what Fast DDS logs; it is called in a thread of Fast DDS.
class Lines : public fast::LogConsumer
{
public:
    void Consume(const fast::Log::Entry& entry) override
    {
        std::lock_guard<std::mutex> guard(lock);
        for (char letter : entry.message)
        {
            text += letter == '\n' || letter == '\t' ? ' ' : letter;
        }
        text += "; ";
    }

    static std::string take()
    {
        fast::Log::Flush();
        std::lock_guard<std::mutex> guard(lock);
        std::string taken;
        taken.swap(text);
        return taken;
    }

private:
    static std::mutex lock;
    static std::string text;
};

std::mutex Lines::lock;
std::string Lines::text;

std::vector<std::string> split(const std::string& text, char mark)
{
    std::vector<std::string> parts(1);
    for (char letter : text)
    {
        if (letter == mark)
        {
            parts.emplace_back();
        }
        else
        {
            parts.back() += letter;
        }
    }
    return parts;
}

using Names = std::vector<std::string>;

// One end of a topic, a writer or a reader.
struct End
{
    fast::DataWriter* writer = nullptr;
    fast::DataReader* reader = nullptr;

    explicit operator bool() const { return writer || reader; }

    bool matched() const
    {
        if (writer)
        {
            fast::PublicationMatchedStatus status;
            writer->get_publication_matched_status(status);
            return status.current_count > 0;
        }
        fast::SubscriptionMatchedStatus status;
        reader->get_subscription_matched_status(status);
        return status.current_count > 0;
    }
};

fast::Topic* topic_of(fast::DomainParticipant* participant, const std::string& name)
{
    auto* known = participant->lookup_topicdescription(name);
    return known ? static_cast<fast::Topic*>(known)
                 : participant->create_topic(name, "sros::Number", fast::TOPIC_QOS_DEFAULT);
}

End open(fast::DomainParticipant* participant, bool writes, const std::string& name, const Names& partitions)
{
    End end;
    auto* topic = topic_of(participant, name);
    if (!topic)
    {
        return end;
    }
    if (writes)
    {
        fast::PublisherQos qos;
        for (const auto& each : partitions)
        {
            qos.partition().push_back(each.c_str());
        }
        end.writer = participant->create_publisher(qos)->create_datawriter(topic, fast::DATAWRITER_QOS_DEFAULT);
    }
    else
    {
        fast::SubscriberQos qos;
        for (const auto& each : partitions)
        {
            qos.partition().push_back(each.c_str());
        }
        end.reader = participant->create_subscriber(qos)->create_datareader(topic, fast::DATAREADER_QOS_DEFAULT);
    }
    return end;
}

struct Pair
{
    End own, others;
};

void await(const std::vector<Pair>& pairs, int milliseconds)
{
    const auto end = std::chrono::steady_clock::now() + std::chrono::milliseconds(milliseconds);
    auto waiting = [&pairs]
    {
        for (const auto& pair : pairs)
        {
            if (pair.own && pair.others && !(pair.own.matched() && pair.others.matched()))
            {
                return true;
            }
        }
        return false;
    };
    while (waiting() && std::chrono::steady_clock::now() < end)
    {
        std::this_thread::sleep_for(std::chrono::milliseconds(10));
    }
}

std::string answer(const std::vector<std::string>& fields)
{
    const auto domain = static_cast<std::uint32_t>(std::stoul(fields[2]));
    setenv("TZ", fields[3].c_str(), 1);
    tzset();
    Lines::take();
    Party self(domain, fields[0], fields[1]);
    if (!self.participant)
    {
        return "refused\t" + Lines::take();
    }
    std::unique_ptr<Party> peer;
    if (fields[4] != "-")
    {
        peer = std::make_unique<Party>(domain, fields[4], fields[5]);
        if (!peer->participant)
        {
            return "peer refused\t" + Lines::take();
        }
    }
    std::vector<Pair> pairs;
    for (std::size_t i = 7; i < fields.size(); ++i)
    {
        const Names words = split(fields[i], '\x1f');
        const Names partitions(words.begin() + 2, words.end());
        const bool writes = words[0] == "publish";
        Pair pair;
        pair.own = open(self.participant, writes, words[1], partitions);
        if (peer && pair.own)
        {
            pair.others = open(peer->participant, !writes, words[1], partitions);
        }
        pairs.push_back(pair);
    }
    await(pairs, std::stoi(fields[6]));
    std::string said = "joined";
    for (const auto& pair : pairs)
    {
        const bool matched = pair.own && pair.others && pair.own.matched() && pair.others.matched();
        said += !pair.own           ? "\tdenied"
                : !peer             ? "\tcreated"
                : !pair.others      ? "\tpeer denied"
                : matched           ? "\tmatched"
                                    : "\tunmatched";
    }
    return said;
}

int stay(std::uint32_t domain, const std::string& folder)
{
    fast::Log::SetVerbosity(fast::Log::Kind::Warning);
    Party self(domain, folder, folder);
    std::cout << (self.participant ? "joined" : "refused") << std::endl;
    while (std::cin.get() != std::istream::traits_type::eof())
    {
    }
    return self.participant ? 0 : 1;
}

int main(int count, char** arguments)
{
    use_sockets();
    if (count > 2)
    {
        return stay(static_cast<std::uint32_t>(std::stoul(arguments[1])), arguments[2]);
    }
    fast::Log::ClearConsumers();  // it writes to standard output
    if (count > 1)
    {
        return probing::probe(static_cast<std::uint32_t>(std::stoul(arguments[1])));
    }
    fast::Log::RegisterConsumer(std::make_unique<Lines>());
    // OpenSSL asks for the pass phrase of an encrypted part on the terminal or from standard input,
    // which is neither a question's answer nor a question: nobody is there to type one.
    FILE* questions = fdopen(dup(0), "r");
    setsid();
    if (!questions || !freopen("/dev/null", "r", stdin))
    {
        return 2;
    }
    char* line = nullptr;
    std::size_t room = 0;
    ssize_t size;
    while ((size = getline(&line, &room, questions)) > 0)
    {
        const std::string asked(line, line[size - 1] == '\n' ? size - 1 : size);
        std::cout << answer(split(asked, '\t')) << std::endl;
    }
}
